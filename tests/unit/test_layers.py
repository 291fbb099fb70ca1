"""The import contracts name every module; a new one would otherwise be free of them."""

from __future__ import annotations

import re
import sys
from pathlib import Path

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[2]


def contracts() -> list[dict[str, object]]:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    found: list[dict[str, object]] = settings["tool"]["importlinter"]["contracts"]
    return found


def test_layers_name_every_module() -> None:
    layers = next(contract for contract in contracts() if contract["type"] == "layers")
    named = set(re.findall(r"[\w.]+", " ".join(map(str, layers["layers"]))))  # type: ignore[call-overload]
    present = {
        f"companion.{path.stem}"
        for path in (ROOT / "companion").iterdir()
        if (path.suffix == ".py" or (path / "__init__.py").exists()) and path.stem != "__init__"
    }
    assert named == present | {"drivers"}
