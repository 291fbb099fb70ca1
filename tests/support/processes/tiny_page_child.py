"""A page that asks for what it is told to: the value of `daemon.flights` lists it.

"end" ends it with status 7; "heed WORDS" waits for a line of the daemon, and ends it with 5 where
that is another.
"""

from __future__ import annotations

import json
import sys

from companion.config_file import config_of_text


def main() -> None:
    told = json.loads(sys.stdin.readline())
    for word in config_of_text(told["config"], "the daemon").daemon.flights.split(","):
        if word == "end":
            sys.exit(7)
        if word.startswith("heed "):
            if sys.stdin.readline() != word.removeprefix("heed ") + "\n":
                sys.exit(5)
            continue
        print(word, flush=True)
    sys.stdin.read()


if __name__ == "__main__":
    main()
