"""The widget: what the search sees in the frames that are shown, and what events look like."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_qtagg import FigureCanvasQTAgg
from qtpy.QtCore import Qt, QTimer
from qtpy.QtWidgets import (
    QApplication,
    QCheckBox,
    QComboBox,
    QFileDialog,
    QFormLayout,
    QGroupBox,
    QHBoxLayout,
    QLabel,
    QLineEdit,
    QPushButton,
    QVBoxLayout,
    QWidget,
)
from superqt import QLabeledDoubleSlider, QLabeledSlider

import iscat_analysis as ia
from iscat_analysis.pipeline.preview import film_limits
from iscat_napari.readers import RESULT, ROW, LazyFrames, LazyMovie

_HEIGHT_PX, _DPI = 200, 72  # the figure is made for a page, and a dock is narrow


class EventPanel(QGroupBox):
    """Shows a row of a result."""

    def __init__(self) -> None:
        super().__init__("Event")
        self.facts = QLabel("click an event of a result")
        self.facts.setWordWrap(True)
        self.facts.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        self.canvas: QWidget | None = None
        self._inside = QVBoxLayout(self)
        self._inside.addWidget(self.facts)
        self._inside.addStretch(1)

    def show_row(self, result: ia.StoredResult, row: int) -> None:
        """Show a row of a result; where there are no images, say why."""
        if self.canvas is not None:
            self._inside.removeWidget(self.canvas)
            self.canvas.deleteLater()
            self.canvas = None
        (name, number), *rest = result.facts(row)
        text = "<br>".join([f"<b>{name} {number}</b>", *(f"{what} {said}" for what, said in rest)])
        try:
            figure = result.view(row)
        except ia.IscatError as error:
            self.facts.setText(f"{text}<br>{error}")
            return
        self.facts.setText(text)
        figure.set_dpi(_DPI)
        self.canvas = FigureCanvasQTAgg(figure)  # type: ignore[no-untyped-call]
        self.canvas.setMinimumHeight(_HEIGHT_PX)
        self._inside.insertWidget(1, self.canvas, 1)


if TYPE_CHECKING:
    import napari

FOUND, RATIO = "found here", "contrast"
"""Names of the layers that the widget adds."""

LEAST_THRESHOLD, MOST_THRESHOLD = 2.0, 20.0
"""Signal-to-noise ratios that can be chosen."""

_SPOT_PX, _THIN = 12.0, 0.06  # side of the mark, and its line's share of it
_LANDS, _LEAVES = "yellow", "deepskyblue"


class Explorer(QWidget):
    """Searches the frames that are shown, and shows the images of events."""

    def __init__(self, napari_viewer: napari.viewer.Viewer) -> None:
        super().__init__()
        self._viewer = napari_viewer
        self._preview: ia.Preview | None = None
        self._movie: Any = None  # of the preview, and what else it was made of
        self._made_of: tuple[int, str, int] = (0, "", 0)
        self._look: ia.Look | None = None
        self._window = 0  # of the last look
        self._ratio: Any = None  # the layer of the contrast

        self.movie = QComboBox()
        self.config = QLineEdit()
        self.config.setPlaceholderText("default configuration")
        browse = QPushButton("…")
        browse.setMaximumWidth(30)
        self.window_frames = QLabeledSlider(Qt.Orientation.Horizontal)
        self.threshold = QLabeledDoubleSlider(Qt.Orientation.Horizontal)
        self.threshold.setRange(LEAST_THRESHOLD, MOST_THRESHOLD)
        self.threshold.setDecimals(2)
        self.follow = QCheckBox("search the frame that is shown, as it changes")
        self.follow.setChecked(True)
        self.detect_button = QPushButton("Detect in the current frames")
        self.ratio_button = QPushButton("Show the contrast as a movie")
        self.status, self.settings = QLabel(), QLabel()
        for label in (self.status, self.settings):
            label.setWordWrap(True)
            label.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        self.event = EventPanel()

        form = QFormLayout()
        form.addRow("movie", self.movie)
        row = QHBoxLayout()
        row.addWidget(self.config)
        row.addWidget(browse)
        form.addRow("configuration", row)
        form.addRow("window [frames]", self.window_frames)
        form.addRow("threshold [SNR]", self.threshold)
        search = QGroupBox("What the search sees here")
        inside = QVBoxLayout(search)
        inside.addLayout(form)
        for widget in (self.follow, self.detect_button, self.ratio_button):
            inside.addWidget(widget)
        inside.addWidget(self.status)
        inside.addWidget(self.settings)
        whole = QVBoxLayout(self)
        whole.addWidget(search)
        whole.addWidget(self.event, 1)

        self._soon = QTimer(self)
        self._soon.setSingleShot(True)
        self._soon.setInterval(30)  # after which the search follows the slider of frames
        self._soon.timeout.connect(self.detect)
        browse.clicked.connect(self._browse)
        self.movie.currentIndexChanged.connect(self._search_soon)
        self.config.editingFinished.connect(self._search_soon)
        self.window_frames.valueChanged.connect(self._search_soon)
        self.threshold.valueChanged.connect(self._threshold_changed)
        self.detect_button.clicked.connect(self.detect)
        self.ratio_button.clicked.connect(self.show_ratio)
        self._listen()
        self._list_layers()

    def _listen(self) -> None:
        """Hear what happens in the viewer, as long as the widget is there."""
        changes, clicks = self._viewer.layers.events, self._viewer.mouse_drag_callbacks
        of_layers = (changes.inserted, changes.removed, changes.renamed)
        heard = [(event, self._list_layers) for event in of_layers]
        heard.append((self._viewer.dims.events.current_step, self._frame_changed))
        for event, callback in heard:
            event.connect(callback)
        clicked = self.on_click
        clicks.append(clicked)

        def leave() -> None:
            for event, callback in heard:
                event.disconnect(callback)
            clicks.remove(clicked)

        self.destroyed.connect(leave)

    # ---- what there is ---------------------------------------------------------------------

    def _list_layers(self, *_: object) -> None:
        """Offer the movies among the layers; take the configuration of the latest result."""
        movies = [layer for layer in self._viewer.layers if _is_movie(layer)]
        chosen = self.movie.currentData()
        if movies != [self.movie.itemData(k) for k in range(self.movie.count())]:
            with _silent(self.movie):
                self.movie.clear()
                for layer in movies:
                    self.movie.addItem(layer.name, layer)
                index = movies.index(chosen) if chosen in movies else 0
                self.movie.setCurrentIndex(index if movies else -1)
            if self.movie.currentData() is not chosen:
                self._search_soon()
        for k, layer in enumerate(movies):
            self.movie.setItemText(k, layer.name)
        results = [r for r in map(_result_of, self._viewer.layers) if r is not None]
        if results and not self.config.text():
            self.config.setText(str(results[-1].folder / "config.toml"))

    def _browse(self) -> None:
        path, _ = QFileDialog.getOpenFileName(self, "Configuration", "", "TOML (*.toml)")
        if path:
            self.config.setText(path)
            self._search_soon()

    @property
    def frame(self) -> int:
        """Number of the frame of the chosen movie that is shown."""
        layer = self.movie.currentData()
        if layer is None:
            return 0
        place = float(layer.world_to_data(self._viewer.dims.point)[-3])
        return min(max(round(place), 0), int(layer.data.shape[0]) - 1)

    # ---- the search ------------------------------------------------------------------------

    def prepare(self) -> ia.Preview | None:
        """Make ready to search the chosen movie with the chosen configuration."""
        layer, path = self.movie.currentData(), self.config.text().strip()
        if layer is None:
            self._say("open a movie first")
            return None
        stamp = Path(path).stat().st_mtime_ns if path and Path(path).is_file() else 0
        movie, wanted = layer.data, (id(layer), path, stamp)
        if self._preview is not None and self._made_of == wanted and self._movie is movie:
            return self._preview
        with self._errors_shown(), _busy():
            is_open = isinstance(movie, LazyMovie)
            stack = movie.stack if is_open else ia.open_stack(movie, name=layer.name)
            config = ia.configure(Path(path) if path else None)
            preview = ia.Preview(stack, config)
            self._preview, self._made_of, self._movie = preview, wanted, movie
            with _silent(self.window_frames):
                self.window_frames.setRange(1, max(preview.longest, 1))
                self.window_frames.setValue(preview.window)
            self._window = 0
            return preview
        self._preview = None
        return None

    def detect(self) -> None:
        """Search the frames that are shown."""
        preview = self.prepare()
        if preview is None:
            return
        window = self.window_frames.value()
        with self._errors_shown():
            if window != self._window:  # each has its threshold, for the same false alarms
                with _silent(self.threshold):
                    self.threshold.setValue(preview.threshold(window))
                self._window = window
                if self._ratio is not None and self._ratio.data.preview is preview:
                    self._ratio.data.window = window
                    self._ratio.refresh()
            self._look = preview.look(self.frame, window)
            self._show_found()

    def _search_soon(self, *_: object) -> None:
        """Search again, where that was asked for before, once nothing changes any more."""
        if self._look is not None:
            self._soon.start()

    def _frame_changed(self, *_: object) -> None:
        if self.follow.isChecked():
            self._search_soon()

    def _threshold_changed(self, *_: object) -> None:
        if self._look is not None:
            with self._errors_shown():
                self._show_found()

    def _show_found(self) -> None:
        """Put what exceeds the threshold into its layer, and say what it is."""
        look, preview, movie = self._look, self._preview, self.movie.currentData()
        if look is None or preview is None or movie is None:
            return
        threshold, window = self.threshold.value(), self.window_frames.value()
        found = look.found(threshold)
        points = np.column_stack(
            [np.full(len(found), self.frame), found[["y_px", "x_px"]].to_numpy(float)]
        )
        colours = [_LANDS if mass >= 0 else _LEAVES for mass in found["mass_kda"]]
        layer = next((one for one in self._viewer.layers if one.name == FOUND), None)
        if layer is None:
            active = self._viewer.layers.selection.active
            marks = {"size": _SPOT_PX, "symbol": "square", "border_width": _THIN}
            marks |= {"face_color": "transparent", "name": FOUND}
            layer = self._viewer.add_points(np.zeros((0, 3)), ndim=3, **marks)
            self._viewer.layers.selection.active = active or layer
        layer.scale, layer.translate = movie.scale[-3:], movie.translate[-3:]
        layer.data = points
        layer.features = found
        layer.border_color = colours or _LANDS
        layer.selected_data = set()
        above = [0.0, -0.75 * _SPOT_PX, 0.0]
        layer.text = {"string": "{snr:.1f}", "size": 8, "color": "white", "translation": above}
        first, last = look.after
        after = f"frame {first}" if last == first + 1 else f"frames {first}:{last}"
        over = "" if look.before is None else f" over {look.before[0]}:{look.before[1]}"
        places = "1 place" if len(found) == 1 else f"{len(found)} places"
        self._say(
            f"{after}{over}: {places} above {threshold:.2f}; "
            f"{preview.false_alarms(threshold, window):.2g} false alarms are expected in the movie"
        )
        self.settings.setText(self._settings(preview, threshold, window))

    def _settings(self, preview: ia.Preview, threshold: float, window: int) -> str:
        """Say with which options the command would search so."""
        settings = []
        if preview.config.background.slides and window != preview.window:
            settings.append(f"--set background.window_frames={window}")
        if abs(threshold - preview.threshold(window)) > 10.0 ** -self.threshold.decimals():
            alarms = preview.false_alarms(threshold, window)
            settings.append(f"--set detection.false_alarms_per_movie={alarms:.3g}")
        return "as in the configuration" if not settings else " ".join(settings)

    def show_ratio(self) -> None:
        """Add the contrast of the windows at every frame as a movie."""
        preview = self.prepare()
        movie = self.movie.currentData()
        if preview is None or movie is None:
            return
        with self._errors_shown(), _busy():
            frames = RatioFrames(preview, movie.data.shape, self.window_frames.value())
            low, high = film_limits(frames.__getitem__, (0, len(frames)))
            limit = max(abs(low), abs(high))
            place = {"scale": movie.scale[-3:], "translate": movie.translate[-3:]}
            greys = {"colormap": "gray", "contrast_limits": (-limit, limit)}
            self._ratio = self._viewer.add_image(frames, name=RATIO, **greys, **place)

    # ---- events ----------------------------------------------------------------------------

    def on_click(self, viewer: Any, event: Any) -> None:
        """Show the event under the mouse."""
        for layer in reversed(viewer.layers):
            result = _result_of(layer)
            if result is None or not layer.visible or not hasattr(layer, "symbol"):
                continue
            seen = {"view_direction": event.view_direction, "dims_displayed": event.dims_displayed}
            index = layer.get_value(event.position, world=True, **seen)
            if index is not None:
                self.show_event(result, int(layer.features[ROW].iloc[index]))
                return

    def show_event(self, result: ia.StoredResult, row: int) -> None:
        """Show data, model and residual of a row of a result."""
        with _busy():
            self.event.show_row(result, row)

    # ---- messages --------------------------------------------------------------------------

    def _say(self, text: str) -> None:
        self.status.setText(text)

    @contextmanager
    def _errors_shown(self) -> Iterator[None]:
        """Show what is wrong with files and settings in place of raising it."""
        try:
            yield
        except ia.IscatError as error:
            self._look = None
            self.settings.clear()
            self._say(str(error))


class RatioFrames(LazyFrames):
    """The contrast at every frame, as the search compares its windows."""

    def __init__(self, preview: ia.Preview, shape: tuple[int, int, int], window: int) -> None:
        super().__init__(shape, np.float32, lambda t: preview.look(t, self.window).image)
        self.preview, self.window = preview, window


def _is_movie(layer: Any) -> bool:
    """Whether a layer may be a camera's movie."""
    data = layer.data
    return (
        getattr(layer, "multiscale", None) is False
        and not getattr(layer, "rgb", True)  # labels have none
        and getattr(data, "ndim", 0) == 3
        and np.dtype(data.dtype).kind in "uif"
        and not isinstance(data, RatioFrames)
    )


def _result_of(layer: Any) -> ia.StoredResult | None:
    found = layer.metadata.get(RESULT)
    return found if isinstance(found, ia.StoredResult) else None


@contextmanager
def _silent(widget: QWidget) -> Iterator[None]:
    """Let a widget be set without telling anybody."""
    widget.blockSignals(True)
    try:
        yield
    finally:
        widget.blockSignals(False)


@contextmanager
def _busy() -> Iterator[None]:
    QApplication.setOverrideCursor(Qt.CursorShape.WaitCursor)
    try:
        yield
    finally:
        QApplication.restoreOverrideCursor()
