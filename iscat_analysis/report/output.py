"""An output folder that appears whole or not at all, and never replaces files of other programs.

The folder is filled under a hidden name beside its own and renamed when it is complete.  It holds a
list of what this program wrote into it; nothing else is ever removed.  One process at a time may
write: it holds a lock that the system releases however the process ends.  Whoever holds the lock
next removes what a killed process left, and puts back an earlier result that it had set aside.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from iscat_analysis.errors import DataError
from iscat_analysis.files import remove_folder, take, unfinished
from iscat_analysis.reading import is_file, is_folder

FILE_LIST = ".iscat-files"
"""The list of files in every output folder: a first line, then a path in each, as JSON."""

OUTPUT_NAMES = frozenset(
    {"fits.csv", "fits.parquet", "tracks.csv", "tracks.parquet", "summary.json", "config.toml"}
    | {"posterior.nc", "response.csv", "report.html", "figures", FILE_LIST}
)
"""Everything `write_report` may leave in its folder."""

BENCHMARK_NAMES = frozenset({"benchmark.json", "benchmark.html", "benchmark.bib", "config.toml"})
"""Everything `write_benchmark` leaves in its folder."""

CHALLENGE_NAMES = frozenset({"challenge.json", "challenge.html", "benchmark.bib"})
"""Everything the score of a challenge leaves in its folder."""

_CALIBRATIONS = ("camera", "calibration", "optics", "template")
_ANSWERS = ("species", "comparison", "kd", "bounds", "benchmark", "challenge")
PAGES = tuple(f"{name}.html" for name in ("report", "batch", *_CALIBRATIONS, *_ANSWERS))
"""Pages that the commands write."""

FORMER = (".png", ".svg")
"""Ends of names that earlier versions wrote beside a page, and ``figures``: what a folder lists may
be replaced."""

_HEADING = "Files of iscat-analysis; what is not in this list is never removed."
_SIGNED = "lock of iscat-analysis, process "
_SYSTEM_FILES = frozenset({".DS_Store", "Thumbs.db", "desktop.ini"})
_BUILDING, _EARLIER, _LOCK = ".iscat-building.", ".iscat-earlier.", ".iscat-lock."
_LONGEST_NAME = 200  # bytes; longer ones leave no room for the words above


def check_output(
    folder: Path, overwrite: bool = False, *, known: Collection[str] = OUTPUT_NAMES
) -> None:
    """Refuse an output folder that must not be written, before any work is done."""
    target = _resolved(folder)
    try:
        if not target.exists():
            return
        if not target.is_dir():
            raise DataError(f"{folder}: is a file, not a folder; choose another `out`")
        listed = _listed(target)
        foreign = _foreign(target, listed, known)
        empty = all(entry.name in _SYSTEM_FILES for entry in target.iterdir())
    except OSError as error:
        raise DataError(f"{folder}: cannot be read ({error.strerror})") from None
    if foreign and not listed and foreign in known:
        raise DataError(
            f"{folder}: holds {foreign!r} but not {FILE_LIST}, the list of what this version "
            "wrote: it may be yours, and is left alone; move it, or choose another `out`"
        )
    if foreign:
        raise DataError(
            f"{folder}: holds {foreign!r}, which is not part of a result, and is left alone; "
            "choose another `out`"
        )
    if not empty and not overwrite:
        raise DataError(
            f"{folder}: holds an earlier result; pass `overwrite` to replace it, or choose "
            "another `out`"
        )


@contextmanager
def claim_output(
    folder: Path, overwrite: bool = False, *, known: Collection[str] = OUTPUT_NAMES
) -> Iterator[None]:
    """Lock an output folder for this process, before any work is done."""
    check_output(folder, overwrite, known=known)
    target = _resolved(folder)
    with _locked(target, folder) as first:
        if first:
            _recover(target)
        check_output(folder, overwrite, known=known)
        yield


@contextmanager
def atomic_folder(
    folder: Path, overwrite: bool = False, *, known: Collection[str] = OUTPUT_NAMES
) -> Iterator[Path]:
    """Fill a temporary sibling, and put it in place only once the block has ended well."""
    with claim_output(folder, overwrite, known=known):
        target = _resolved(folder)
        building = _hidden_folder(_BUILDING, target)
        try:
            with unfinished(building):
                try:
                    _make_ours(building)
                except OSError as error:
                    raise DataError(
                        f"{folder}: cannot be made ({error.strerror}); choose another `out`"
                    ) from None
                yield building
                _like_an_ordinary_folder(building)
                _list_files(building)
                check_output(folder, overwrite, known=known)
            _swap(building, target)
        except OSError as error:
            raise DataError(f"{folder}: cannot be written ({error.strerror or error})") from error
        finally:
            remove_folder(building)


def _resolved(folder: Path) -> Path:
    """Resolve links and ``..``; the folders on the way need not exist."""
    try:
        target = folder.resolve()
    except (OSError, RuntimeError, ValueError) as error:  # RuntimeError: links in a circle
        raise DataError(f"{folder}: cannot be found ({error}); choose another `out`") from None
    if not target.name:
        raise DataError(f"{folder}: is the root of all folders; choose another `out`")
    return target


def _short(target: Path) -> str:
    """Give the target's name, or its hash where names with a prefix would become too long."""
    raw = os.fsencode(target.name)
    return target.name if len(raw) <= _LONGEST_NAME else hashlib.sha256(raw).hexdigest()


def _hidden_folder(kind: str, target: Path) -> Path:
    """Choose the name of a hidden folder beside the target, without making the folder."""
    return target.with_name(f"{kind}{secrets.token_hex(4)}.{_short(target)}")


# ---- What is ours --------------------------------------------------------------------------------


def _make_ours(folder: Path) -> None:
    """Make a folder with an empty list of its files."""
    folder.mkdir(0o700)
    (folder / FILE_LIST).write_text(f"{_HEADING}\n", encoding="utf-8")


def _list_files(folder: Path) -> None:
    """Add all files of a folder to its list."""
    names = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))
    with (folder / FILE_LIST).open("a", encoding="utf-8") as file:
        file.writelines(f"{json.dumps(name)}\n" for name in names)


def _listed(folder: Path) -> frozenset[str]:
    """Read the paths in a folder's list, the list included; empty if the list is not ours."""
    path = folder / FILE_LIST
    try:
        if path.is_symlink() or not path.is_file():
            return frozenset()
        heading, *lines = path.read_text(encoding="utf-8").splitlines()
        if heading != _HEADING:
            return frozenset()
        return frozenset([FILE_LIST, *(str(json.loads(line)) for line in lines)])
    except (OSError, ValueError, RecursionError):
        return frozenset()


def _foreign(folder: Path, listed: Collection[str], known: Collection[str]) -> str:
    """Find something in a folder that its list does not name."""
    for name in _inside(folder):
        top = name.partition("/")[0]
        ours = top in known or top == FILE_LIST or top == "figures" or top.endswith(FORMER)
        if name not in listed or not ours:
            return name
    return ""


def _inside(folder: Path, *, deepest_first: bool = False) -> Iterator[str]:
    """List the paths in a folder without following links, system files left out."""

    def refuse(error: OSError) -> None:
        raise error

    for where, folders, files in os.walk(folder, topdown=not deepest_first, onerror=refuse):
        for name in sorted({*folders, *files} - _SYSTEM_FILES):
            yield (Path(where) / name).relative_to(folder).as_posix()


def _remove_listed(folder: Path) -> None:
    """Remove the files of a folder's list, the list last, and the folder if it is then empty."""
    listed = _listed(folder)
    with suppress(OSError):
        for name in _inside(folder, deepest_first=True):
            path = folder / name
            if name not in listed or name == FILE_LIST:
                continue
            with suppress(OSError):  # a folder that holds something else
                if path.is_dir() and not path.is_symlink():
                    for system_file in _SYSTEM_FILES:
                        (path / system_file).unlink(missing_ok=True)
                    path.rmdir()
                else:
                    path.unlink()
        if all(entry.name in {*_SYSTEM_FILES, FILE_LIST} for entry in folder.iterdir()):
            remove_folder(folder)


# ---- Locks ---------------------------------------------------------------------------------------


def _sign(handle: int) -> None:
    """Write the owner into a lock file; on a full disk it stays empty."""
    with suppress(OSError):
        os.ftruncate(handle, 0)
        os.write(handle, f"{_SIGNED}{os.getpid()}\n".encode())


@contextmanager
def _locked(target: Path, folder: Path) -> Iterator[bool]:
    """Lock a folder; tell whether this process did not hold the lock before."""
    # What the lock file is called must not depend on who may write into the folder itself.
    path = target.parent / f"{_LOCK}{_short(target)}"
    lock = FileLock(
        path, thread_local=False, is_singleton=True, fallback_to_soft=False, on_acquired=_sign
    )
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        before = _state_of_lock(path)
        locked = take(lock, 0)
    except Timeout:
        owner = _owner(path)
        who = f" (process {owner})" if owner else ""
        raise DataError(
            f"{folder}: another run{who} is about to write there; wait for it, or choose "
            "another `out`"
        ) from None
    except OSError as error:
        raise DataError(
            f"{folder}: cannot be made ({error.strerror}); choose another `out`"
        ) from None
    ours = before is None or before.st_size > 0 or not _is_still(path, before)
    try:
        first = locked and lock.lock_counter == 1
        if first and ours:
            with unfinished(path):
                yield first
        else:
            yield first
    finally:
        if ours and (not locked or lock.lock_counter == 1):
            path.unlink(missing_ok=True)  # before it is released: nobody waits for this file
        if locked:
            lock.release()


def _state_of_lock(path: Path) -> os.stat_result | None:
    """Give the state of a lock file of ours, or of an empty one; refuse what is something else."""
    if not path.is_symlink() and not path.exists():
        return None
    if path.is_symlink() or not path.is_file() or _owner(path) is None:
        raise DataError(
            f"{path}: is in the place of a lock, but is not one, and is left alone; move it, or "
            "choose another `out`"
        )
    return path.lstat()


def _owner(path: Path) -> str | None:
    """Read which process holds a lock file; empty where it says nothing, None if it is no lock."""
    try:
        with path.open("rb") as file:
            head = file.read(len(_SIGNED) + 20).decode("ascii", "replace")
    except OSError:
        return ""
    return None if head and not head.startswith(_SIGNED) else head.removeprefix(_SIGNED).strip()


def _is_still(path: Path, before: os.stat_result) -> bool:
    """Tell whether a path is still the file that it was."""
    try:
        return os.path.samestat(path.lstat(), before)
    except OSError:
        return False


# ---- Putting in place ----------------------------------------------------------------------------


def _recover(target: Path) -> None:
    """Remove what a killed run left, and restore an earlier result."""
    end = f".{_short(target)}"
    for entry in list(target.parent.iterdir()):
        for kind in (_BUILDING, _EARLIER):
            middle = entry.name.removeprefix(kind).removesuffix(end)
            if entry.name != f"{kind}{middle}{end}" or not middle or "." in middle:
                continue
            if entry.is_symlink() or not _listed(entry):  # the name alone does not make it ours
                continue
            kept = entry / target.name
            if kind == _EARLIER and kept.is_dir() and not target.exists():
                kept.rename(target)
            if kind == _EARLIER:
                _remove_earlier(entry, kept)
            else:
                remove_folder(entry)


def _remove_earlier(earlier: Path, kept: Path) -> None:
    """Remove an earlier result that was set aside; files added to it since then stay."""
    if kept.is_dir():
        _remove_listed(kept)
    if not kept.exists():
        _remove_listed(earlier)


def _like_an_ordinary_folder(folder: Path) -> None:
    """Give a folder that only its owner may read the permissions of an ordinary new folder."""
    probe = folder / ".mode"
    probe.mkdir()
    folder.chmod(probe.stat().st_mode)
    probe.rmdir()


def _swap(building: Path, target: Path) -> None:
    """Put a complete folder in place; if it is interrupted, one of both results is in place."""
    if not target.exists():
        building.rename(target)
        return
    earlier = _hidden_folder(_EARLIER, target)
    kept = earlier / target.name
    try:
        _make_ours(earlier)
        target.rename(kept)
        building.rename(target)
    finally:
        if kept.exists() and not target.exists():
            kept.rename(target)
        if target.exists():
            _remove_earlier(earlier, kept)


# ---- The page of a result ------------------------------------------------------------------------


def page_of(result: Path) -> Path:
    """Find the page of a result."""
    if result.suffix.lower() in (".html", ".htm") and is_file(result):
        return result
    folder = result.with_suffix(".iscat") if is_file(result) else result
    found = [folder / name for name in PAGES if is_file(folder / name)]
    if found:
        return found[0]
    if is_folder(folder):
        raise DataError(
            f"{folder}: holds no page ({', '.join(PAGES)}); give the output folder of iscat fit, "
            "batch, calibrate, species, kd, bounds or benchmark"
        )
    if is_file(result):
        raise DataError(
            f"{result}: has no result beside it ({folder.name}); analyse it with iscat fit, or "
            "give the folder of its result"
        )
    raise DataError(f"{result}: there is no such folder; check the path")
