"""An output folder that appears whole or not at all, and never eats what it did not write."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from iscat_analysis.errors import DataError

OUTPUT_NAMES = frozenset(
    {
        "fits.csv",
        "fits.parquet",
        "summary.json",
        "config.toml",
        "posterior.nc",
        "report.html",
        "figures",
    }
)
"""Everything `write_report` may leave in its folder."""

_LITTER = frozenset({".DS_Store", "Thumbs.db", "desktop.ini"})


def check_output(
    folder: Path, overwrite: bool = False, *, known: Collection[str] = OUTPUT_NAMES
) -> None:
    """Refuse an output folder that must not be written, before any work is done.

    Parameters
    ----------
    folder : Path
        Where the results shall go.
    overwrite : bool
        Whether an earlier result there may be replaced.
    known : collection of str
        Names that an earlier result consists of; a folder that holds anything else is never
        replaced, so that ``--out ~ --overwrite`` costs nobody their home.

    Raises
    ------
    DataError
        The folder is a file, holds an earlier result and `overwrite` is false, or holds something
        else.
    """
    try:
        if not folder.exists():
            return
        if not folder.is_dir():
            raise DataError(f"{folder}: is a file, not a folder; choose another --out")
        entries = sorted(entry.name for entry in folder.iterdir() if entry.name not in _LITTER)
    except OSError as error:
        raise DataError(f"{folder}: cannot be read ({error.strerror})") from None
    foreign = [name for name in entries if name not in known]
    if foreign:
        raise DataError(
            f"{folder}: holds {foreign[0]!r}, which is not part of a result, and is left alone; "
            "choose another --out"
        )
    if entries and not overwrite:
        raise DataError(
            f"{folder}: holds an earlier result; add --overwrite to replace it, or choose "
            "another --out"
        )


@contextmanager
def atomic_folder(
    folder: Path, overwrite: bool = False, *, known: Collection[str] = OUTPUT_NAMES
) -> Iterator[Path]:
    """Fill a temporary sibling, and put it in place only once the block has ended well.

    Parameters
    ----------
    folder : Path
        Where the results shall go; its parents are made.
    overwrite : bool
        Whether an earlier result there may be replaced; it stays until the new one is complete.
    known : collection of str
        As in `check_output`.

    Yields
    ------
    Path
        The temporary folder to write into.

    Raises
    ------
    DataError
        As in `check_output`, or the disk refuses.
    """
    check_output(folder, overwrite, known=known)
    target = folder.resolve()
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        building = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    except OSError as error:
        raise DataError(
            f"{folder}: cannot be made ({error.strerror}); choose another --out"
        ) from None
    try:
        yield building
        _like_an_ordinary_folder(building)
        check_output(folder, overwrite, known=known)
        _swap(building, target)
    except OSError as error:
        raise DataError(f"{folder}: cannot be written ({error.strerror or error})") from error
    finally:
        shutil.rmtree(building, ignore_errors=True)


def _like_an_ordinary_folder(folder: Path) -> None:
    """Give a folder from `mkdtemp`, which only its owner may read, the mode `mkdir` would."""
    probe = folder / ".mode"
    probe.mkdir()
    folder.chmod(probe.stat().st_mode)
    probe.rmdir()


def _swap(building: Path, target: Path) -> None:
    if not target.exists():
        building.rename(target)
        return
    earlier = Path(tempfile.mkdtemp(prefix=f".{target.name}.earlier.", dir=target.parent))
    try:
        target.rename(earlier / target.name)
        try:
            building.rename(target)
        except OSError:
            (earlier / target.name).rename(target)
            raise
    finally:
        shutil.rmtree(earlier, ignore_errors=True)
