"""`companion film`: a film of a flight from its run and its pictures."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from companion.app.progress import Progress
from companion.app.run_pictures import open_pictures
from companion.config import Config
from companion.messages import Bytes
from companion.products.film.flight_film import FilmSize, film_frames
from companion.products.run_folder import read_run
from drivers.images.film_file import check_film_name, write_film


def film(
    folder: Path, flight: Path | None, out: Path, size: FilmSize, config: Config, progress: Progress
) -> int:
    """Write a film of the run in `folder` to the file `out`; the number of its frames.

    Without `flight` it has no pictures. InputError where the run or the name will not do.
    """
    check_film_name(out)
    run = read_run(folder)
    pictures = open_pictures(flight, config) if flight is not None else iter(())
    n = max(round(size.length_s * size.rate_hz), 2)

    def counted() -> Iterator[Bytes]:
        for k, frame in enumerate(film_frames(run, pictures, size), 1):
            progress.update(k, "drawing", 0)
            yield frame

    progress.start(n)
    try:
        return write_film(out, counted(), size.rate_hz)
    finally:
        progress.finish()
