"""A page that asks for what it is told to: the value of `daemon.flights` lists it."""

from __future__ import annotations

import json
import sys

from companion.config_file import config_of_text


def main() -> None:
    told = json.loads(sys.stdin.readline())
    for word in config_of_text(told["config"], "the daemon").daemon.flights.split(","):
        if word == "end":
            sys.exit(7)
        print(word, flush=True)
    sys.stdin.read()


if __name__ == "__main__":
    main()
