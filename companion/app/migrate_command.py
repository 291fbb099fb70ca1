"""`companion check-config --migrate`: writes a configuration file of the version before anew."""

from __future__ import annotations

from pathlib import Path
from typing import TextIO

import tomlkit

from companion.config_file import current_key, load_config, values_in, values_of
from companion.errors import ConfigError
from companion.products.atomic_file import write_atomically


def migrate(path: Path, out: TextIO) -> None:
    """Rename and remove keys of the version before; the file as it was stays beside it, as .bak.

    Comments stay where they are. ConfigError where the file cannot be read or written.
    """
    changes: list[str] = []
    load_config(path, warn=changes.append)
    if not changes:
        print(f"{path}: all keys are those of this version", file=out)
        return
    path = path.resolve()
    before, document = values_in(path), tomlkit.parse(path.read_bytes())
    for name in before:
        _move(document, name, current_key(name))
    after = tomlkit.dumps(document)
    wanted = {current_key(name): value for name, value in before.items() if current_key(name)}
    if values_of(after, str(path)) != wanted:
        raise ConfigError(f"{path}: is written too unusually to be changed: rename by hand")
    backup = path.with_name(f"{path.name}.bak")
    try:
        write_atomically(backup, path.read_bytes(), durable=True, like=path)
        write_atomically(path, after.encode(), durable=True, like=path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written anew: {error.strerror}") from error
    print(*changes, f"{path}: written anew; as it was: {backup}", sep="\n", file=out)


def _move(document: tomlkit.TOMLDocument, name: str, to: str) -> None:
    if name == to:
        return
    section, key = name.split(".")
    table = document[section]
    item = table.pop(key)
    if not table.as_string().strip():
        document.remove(section)
    if to:
        expert, section, _ = to.split(".")
        tables = document.setdefault(expert, tomlkit.table(is_super_table=True))
        tables.setdefault(section, tomlkit.table()).append(key, item)
