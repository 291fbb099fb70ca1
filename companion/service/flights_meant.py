"""Default folder of flights for commands."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from companion.config_file import load_config
from companion.errors import InputError
from companion.service.install_paths import PACKAGED_UNITS, SYSTEM, Places, user_places


def flights_meant(
    config: Path | None, overrides: Sequence[str], services: Sequence[Places]
) -> Path:
    """Folder where `companion run` with the same options, or else a service puts its flights.

    With a configuration or `daemon.flights` among the overrides: by these, relative to here. Else
    by the configuration of the first installed service, relative to its working directory. Without
    a service: by the defaults, relative to here.
    """
    given = config is not None or any(each.startswith("daemon.flights") for each in overrides)
    service = None if given or not services else services[0]
    if service is not None:
        config = service.config
    elif config is not None:
        service = next((each for each in services if _same(each.config, config)), None)
    flights = Path(load_config(config, overrides).daemon.flights)
    return (Path() if service is None else service.working).absolute() / flights


def installed_services(environment: Mapping[str, str] = os.environ) -> list[Places]:
    """Installed services: the user's own, then the computer's."""
    found = []
    try:
        own = user_places(environment)
    except InputError:
        pass  # no home: no service in it
    else:
        found += [own] if own.unit.exists() else []
    found += [SYSTEM] if any(unit.exists() for unit in (SYSTEM.unit, *PACKAGED_UNITS)) else []
    return found


def _same(a: Path, b: Path) -> bool:
    return os.path.abspath(a) == os.path.abspath(b)
