"""Layers of files: movies, whose frames are made when they are looked at, and results."""

from __future__ import annotations

import contextlib
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import iscat_analysis as ia
from iscat_analysis.pipeline.preview import film_limits
from iscat_analysis.pipeline.stored import SHOWN_FRAMES


class LazyFrames:
    """What a viewer takes for an array (t, y, x): each frame is made when it is asked for."""

    ndim = 3

    def __init__(
        self, shape: tuple[int, int, int], dtype: Any, frame: Callable[[int], NDArray[Any]]
    ) -> None:
        self.shape = shape
        self.dtype = np.dtype(dtype)
        self._frame = frame

    @property
    def size(self) -> int:
        """How many numbers it holds."""
        return int(np.prod(self.shape, dtype=np.int64))

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, key: Any) -> NDArray[Any]:
        wanted, *rest = key if isinstance(key, tuple) else (key,)
        if wanted is Ellipsis:
            wanted, rest = slice(None), [Ellipsis, *rest]
        numbers = np.arange(self.shape[0])[wanted]
        if np.ndim(numbers) == 0:
            return np.asarray(np.asarray(self._frame(int(numbers)))[tuple(rest)])
        out = np.empty((len(numbers), *self.shape[1:]), dtype=self.dtype)
        for place, number in enumerate(numbers):
            out[place] = self._frame(int(number))
        return np.asarray(out[(slice(None), *rest)])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.asarray(self[:], dtype=dtype)


class LazyMovie(LazyFrames):
    """The counts of an open movie; it is closed when nothing shows it any more."""

    def __init__(self, stack: ia.Stack) -> None:
        super().__init__(stack.shape, stack.dtype, lambda t: stack.read(t, t + 1)[0])
        self.stack = stack
        weakref.finalize(self, stack.close)


LayerData = tuple[Any, dict[str, Any], str]
"""Data, options and kind of a layer, as napari takes them."""

RESULT, ROW = "iscat_result", "row"
"""Key of a layer's metadata that holds the `StoredResult`, and the feature with its table's row."""


def movie_reader(path: str | Sequence[str]) -> Callable[[Any], list[LayerData]] | None:
    """Tell whether this is a movie that `open_stack` may read."""
    if not isinstance(path, str) or _is_result(Path(path)):
        return None
    if Path(path).is_dir() and Path(path).suffix.lower() != ".zarr":
        return None
    return lambda path: [movie_layer(LazyMovie(ia.open_stack(path)))]


def result_reader(path: str | Sequence[str]) -> Callable[[Any], list[LayerData]] | None:
    """Tell whether this is the output folder of a movie."""
    if not isinstance(path, str) or not _is_result(Path(path)):
        return None
    return lambda path: result_layers(ia.open_result(path))


def _is_result(path: Path) -> bool:
    return path.is_dir() and (path.suffix == ".iscat" or (path / "fits.parquet").is_file())


def movie_layer(movie: LazyMovie) -> LayerData:
    """Make the layer of a movie."""
    limits = film_limits(movie.__getitem__, (0, len(movie)))
    options = {"name": movie.stack.name, "contrast_limits": limits, "colormap": "gray"}
    return movie, options, "image"


def result_layers(result: ia.StoredResult) -> list[LayerData]:
    """Make the layers of a result."""
    layers: list[LayerData] = []
    name = result.folder.name
    with contextlib.suppress(ia.DataError):  # the table is worth looking at without the movie
        layers.append(movie_layer(LazyMovie(ia.open_stack(result.movie_path))))
    if len(result.tracks):
        layers += _tracks_layer(result)
    table = result.table
    placed = table[table[["x_px", "y_px"]].notna().all(axis=1)]
    points = placed[["frame", "y_px", "x_px"]].to_numpy(float)
    scale = [1.0, 1.0, 1.0]
    if "landing" in result.summary:  # a slice is one step of the data thick
        scale[0] = float(SHOWN_FRAMES)
        points[:, 0] /= SHOWN_FRAMES
    elif result.analysis.tracks is None:  # they are there in all frames after the background
        points, scale = points[:, 1:], scale[1:]
    colours = ["lime" if status == ia.Status.OK else "orange" for status in placed["status"]]
    options = {
        "name": f"{name} events",
        "features": placed.assign(**{ROW: placed.index}).reset_index(drop=True),
        "face_color": "transparent",
        "border_color": colours or "lime",
        "size": 12.0,
        "border_width": 0.06,
        "scale": scale,
        "metadata": {RESULT: result},
        "ndim": points.shape[1],
    }
    return [*layers, (points, options, "points")]


def _tracks_layer(result: ia.StoredResult) -> list[LayerData]:
    """Make the layer of tracks; the features of a place are its row, and its track's."""
    rows = ia.tracked_rows(result.table)
    if not len(rows):
        return []
    whole = result.tracks.set_index("track").add_prefix("track_")
    features = rows.drop(columns="track", errors="ignore").join(whole, on="particle")
    options = {
        "name": f"{result.folder.name} tracks",
        # numbers are all that colours of tracks can be made of
        "features": features.assign(**{ROW: rows.index})
        .select_dtypes("number")
        .astype(float)
        .reset_index(drop=True),
        "metadata": {RESULT: result},
    }
    data = rows[["particle", "frame", "y_px", "x_px"]].to_numpy(float)
    return [(data, options, "tracks")]
