"""The door for what is read whole: regular files, of a size and a depth that such a file can have.

A pipe keeps whoever opens it waiting, a device never ends, and brackets in brackets exhaust the
stack.  Whatever cannot be read raises an `OSError` with a reason, or a `ValueError`.
"""

from __future__ import annotations

import errno
import io
import json
import os
import re
import stat
import struct
import tokenize
import tomllib
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TypeVar

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray
    from pydantic import BaseModel

M = TypeVar("M", bound="BaseModel")

LARGEST_TEXT_BYTES = 10_000_000
"""No configuration, list of samples or summary is longer."""

LARGEST_TEMPLATE_BYTES = 100_000_000
"""No measured picture of a particle is larger."""

OF_DAMAGE = (
    OSError,
    EOFError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    SyntaxError,
    MemoryError,
    RuntimeError,
    ArithmeticError,
    tokenize.TokenError,
    struct.error,
)
"""What damaged files make libraries raise."""

_FLAGS = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
_MOST_DOTS = 64  # of a key; tomllib takes the square of their number
_DOT = re.compile(r"(?<!\.)\.(?!\.)")


def is_file(path: Path) -> bool:
    """Tell whether a regular file is there; there is none of a name that no file can have."""
    try:
        return path.is_file()
    except OSError:
        return False


def is_folder(path: Path) -> bool:
    """Tell whether a folder is there."""
    try:
        return path.is_dir()
    except OSError:
        return False


def open_regular(path: Path, most: int | None = None) -> io.BufferedReader:
    """Open a regular file, of so many bytes at most, and never wait for a pipe."""
    try:
        handle = os.open(path, _FLAGS | getattr(os, "O_CLOEXEC", 0))
    except ValueError:
        raise OSError(errno.EINVAL, "this is no name of a file", str(path)) from None
    state = os.fstat(handle)
    why = errno.EINVAL, "it is a pipe or a device; give a file"
    if stat.S_ISDIR(state.st_mode):
        why = errno.EISDIR, os.strerror(errno.EISDIR)
    elif stat.S_ISREG(state.st_mode):
        if most is None or state.st_size <= most:
            return os.fdopen(handle, "rb")
        why = errno.EFBIG, f"it is {state.st_size} bytes long, and such a file has {most} at most"
    os.close(handle)
    raise OSError(*why, str(path))


def read_bytes(path: Path, most: int = LARGEST_TEXT_BYTES) -> bytes:
    """Read a regular file."""
    with open_regular(path, most) as file:
        return file.read(os.fstat(file.fileno()).st_size)


def read_text(path: Path, errors: str = "strict") -> str:
    """Read a text in UTF-8, with or without a byte order mark."""
    return read_bytes(path).decode("utf-8-sig", errors).replace("\r\n", "\n").replace("\r", "\n")


def read_json(path: Path) -> Any:
    """Read a JSON file."""
    return json_of(read_text(path))


def summary_in(folder: Path) -> dict[str, Any]:
    """Read ``summary.json`` of a result; empty where there is none, or it is not ours."""
    try:
        found = read_json(folder / "summary.json")
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def json_of(text: str) -> Any:
    """Read JSON."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("its brackets are nested too deep") from None


def model_of(model: type[M], text: str | bytes) -> M:
    """Read JSON of a known form; the error names the first key that is not of it."""
    from pydantic import ValidationError

    try:
        return model.model_validate_json(text, strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        key = ".".join(map(str, first["loc"]))
        raise ValueError(f"{key[:90]}: {first['msg'][:100]}".removeprefix(": ")) from None


def toml_of(text: str) -> dict[str, Any]:
    """Read TOML."""
    pieces = (piece for line in text.splitlines() for piece in re.split("[=,#]", line))
    if any(len(_DOT.findall(piece)) > _MOST_DOTS for piece in pieces if len(piece) > _MOST_DOTS):
        raise tomllib.TOMLDecodeError(f"a key of more than {_MOST_DOTS} parts")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        raise
    except ValueError:  # of Python, which makes no integers of thousands of digits
        raise tomllib.TOMLDecodeError("a number has too many digits, or is no date") from None
    except RecursionError:
        raise tomllib.TOMLDecodeError("its brackets are nested too deep") from None


def npz_of(content: bytes, most: int) -> dict[str, NDArray[Any]]:
    """Read arrays of a ``.npz`` file, of so many bytes at most when they are unpacked."""
    import numpy as np

    try:
        with zipfile.ZipFile(io.BytesIO(content)) as file:
            if sum(entry.file_size for entry in file.infolist()) > most:
                raise ValueError(f"its arrays are larger than {most} bytes")
        with np.load(io.BytesIO(content), allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}
    except (zipfile.BadZipFile, zlib.error, *OF_DAMAGE) as error:
        raise ValueError(first_line(error)) from None


def first_line(error: BaseException) -> str:
    """Give the first line of what an error says, and no more than a line holds."""
    line = next((line.strip() for line in str(error).splitlines() if line.strip()), "")
    return line[:200] or type(error).__name__  # characters of what a library says


def read_parquet(path: Path, columns: Sequence[str] | None = None) -> pd.DataFrame:
    """Read a table from a Parquet file."""
    with open_regular(path) as file:
        return parquet_of(file, columns)


def parquet_of(file: BinaryIO, columns: Sequence[str] | None = None) -> pd.DataFrame:
    """Read a table from the content of a Parquet file."""
    import pandas as pd
    import pyarrow as pa

    try:
        return pd.read_parquet(file, columns=None if columns is None else list(columns))
    except (pa.ArrowException, *OF_DAMAGE) as error:
        raise ValueError(first_line(error)) from None
