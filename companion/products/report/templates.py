"""HTML templates of the pages of results."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined


def rendered(template: str, *filters: Callable[..., Any], **values: Any) -> bytes:
    """HTML of a template of this package, in UTF-8; filters have the names of their functions."""
    environment = Environment(
        loader=PackageLoader("companion.products.report", ""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update({each.__name__: each for each in filters})
    return environment.get_template(template).render(**values).encode("utf-8")
