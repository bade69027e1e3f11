"""An output folder that appears whole or not at all, and never replaces files of other programs.

The folder is filled under a hidden name beside its own and renamed when it is complete.  One
process at a time may do so: it holds a lock that the system releases however the process ends.
Whoever holds the lock next removes what a killed process left, and puts back an earlier result
that it had set aside.
"""

from __future__ import annotations

import errno
import hashlib
import os
import secrets
import shutil
import sys
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from iscat_analysis.errors import DataError
from iscat_analysis.files import remove_folder, unfinished

OUTPUT_NAMES = frozenset(
    {
        "fits.csv",
        "fits.parquet",
        "tracks.csv",
        "tracks.parquet",
        "summary.json",
        "config.toml",
        "posterior.nc",
        "response.csv",
        "report.html",
        "figures",
    }
)
"""Everything `write_report` may leave in its folder."""

_LITTER = frozenset({".DS_Store", "Thumbs.db", "desktop.ini"})
_BUILDING, _EARLIER, _LOCK = ".iscat-building.", ".iscat-earlier.", ".iscat-lock."
_LONGEST_NAME = 200  # bytes; longer ones leave no room for the words above
_NO_LOCKS = {errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL}
_LOCK_ATTEMPTS = 100


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
        entries = sorted(entry.name for entry in target.iterdir() if entry.name not in _LITTER)
    except OSError as error:
        raise DataError(f"{folder}: cannot be read ({error.strerror})") from None
    foreign = [name for name in entries if name not in known]
    if foreign:
        raise DataError(
            f"{folder}: holds {foreign[0]!r}, which is not part of a result, and is left alone; "
            "choose another `out`"
        )
    if entries and not overwrite:
        raise DataError(
            f"{folder}: holds an earlier result; pass `overwrite` to replace it, or choose "
            "another `out`"
        )


@contextmanager
def claim_output(
    folder: Path, overwrite: bool = False, *, known: Collection[str] = OUTPUT_NAMES
) -> Iterator[None]:
    """Hold an output folder for this process, before any work is done."""
    check_output(folder, overwrite, known=known)
    target = _resolved(folder)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        # What the lock file is called must not depend on who may write into the folder itself.
        lock = target.parent / f"{_LOCK}{_short(target)}"
        held = _acquire(lock, folder)
    except OSError as error:
        raise DataError(
            f"{folder}: cannot be made ({error.strerror}); choose another `out`"
        ) from None
    if held is None:
        check_output(folder, overwrite, known=known)
        yield
        return
    try:
        with unfinished(lock):
            _recover(target)
            check_output(folder, overwrite, known=known)
            yield
    finally:
        lock.unlink(missing_ok=True)  # before it is released: no other run waits for this file
        os.close(held)


@contextmanager
def atomic_folder(
    folder: Path, overwrite: bool = False, *, known: Collection[str] = OUTPUT_NAMES
) -> Iterator[Path]:
    """Fill a temporary sibling, and put it in place only once the block has ended well."""
    with claim_output(folder, overwrite, known=known):
        target = _resolved(folder)
        building = _hidden(_BUILDING, target)
        try:
            with unfinished(building):
                try:
                    building.mkdir(0o700)
                except OSError as error:
                    raise DataError(
                        f"{folder}: cannot be made ({error.strerror}); choose another `out`"
                    ) from None
                yield building
                _like_an_ordinary_folder(building)
                check_output(folder, overwrite, known=known)
            _swap(building, target)
        except OSError as error:
            raise DataError(f"{folder}: cannot be written ({error.strerror or error})") from error
        finally:
            remove_folder(building)


def _resolved(folder: Path) -> Path:
    """Resolve links and ``..``; the folders on the way need not exist."""
    try:
        return folder.resolve()
    except (OSError, RuntimeError) as error:  # RuntimeError: links in a circle, before 3.13
        raise DataError(f"{folder}: cannot be found ({error}); choose another `out`") from None


def _short(target: Path) -> str:
    """Give the target's name, or its hash where names with a prefix would become too long."""
    raw = os.fsencode(target.name)
    return target.name if len(raw) <= _LONGEST_NAME else hashlib.sha256(raw).hexdigest()


def _hidden(kind: str, target: Path) -> Path:
    """Choose the name of a hidden folder beside the target, without making the folder."""
    return target.with_name(f"{kind}{secrets.token_hex(4)}.{_short(target)}")


if sys.platform == "win32":  # without locks, of two runs into one folder the last to end wins

    def _acquire(lock: Path, folder: Path) -> int | None:
        del lock, folder
        return None

else:
    import fcntl

    def _acquire(lock: Path, folder: Path) -> int | None:
        """Take the lock; None where this process has it already, or the disk knows no locks."""
        for _ in range(_LOCK_ATTEMPTS):
            handle = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                owner = os.read(handle, 20).decode("ascii", "replace").strip()
                os.close(handle)
                if owner == str(os.getpid()):
                    return None
                who = f" (process {owner})" if owner else ""
                raise DataError(
                    f"{folder}: another run{who} is about to write there; wait for it, or choose "
                    "another `out`"
                ) from None
            except OSError as error:
                os.close(handle)
                if error.errno in _NO_LOCKS:
                    return None
                raise
            if _is_still(lock, handle):
                os.ftruncate(handle, 0)
                os.write(handle, str(os.getpid()).encode())
                return handle
            os.close(handle)  # another run removed the file between opening and locking it
        raise DataError(f"{folder}: other runs keep writing there; choose another `out`")

    def _is_still(lock: Path, handle: int) -> bool:
        try:
            return os.path.samestat(lock.stat(), os.fstat(handle))
        except FileNotFoundError:
            return False


def _recover(target: Path) -> None:
    """Remove what a killed run left beside the target, and put an earlier result back."""
    end = f".{_short(target)}"
    for entry in list(target.parent.iterdir()):
        for kind in (_BUILDING, _EARLIER):
            middle = entry.name.removeprefix(kind).removesuffix(end)
            if entry.name != f"{kind}{middle}{end}" or not middle or "." in middle:
                continue
            kept = entry / target.name
            if kind == _EARLIER and kept.is_dir() and not target.exists():
                kept.rename(target)
            shutil.rmtree(entry, ignore_errors=True)


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
    earlier = _hidden(_EARLIER, target)
    kept = earlier / target.name
    try:
        earlier.mkdir(0o700)
        target.rename(kept)
        building.rename(target)
    finally:
        if kept.exists() and not target.exists():
            kept.rename(target)
        if target.exists():
            remove_folder(earlier)
