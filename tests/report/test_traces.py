"""Contrast against frame and ratiometric clips, as the page shows them."""

from __future__ import annotations

import base64
import io
import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from report_factory import make_analysis, with_traces

from iscat_analysis.fitting.run import packed, unpacked
from iscat_analysis.notebook import Result
from iscat_analysis.records import Clip, EventView, Trace
from iscat_analysis.report.pictures import (
    CLIP_MS,
    Scale,
    clip_shown,
    event_details,
    trace_data,
    trace_words,
)
from iscat_analysis.report.tables import event_table


def _trace(frames: int = 300, *, first: int = 100, turn: int = 250) -> Trace:
    frame = first + np.arange(frames)
    contrast = np.where(frame < turn, 0.0, -0.004) + 1e-3 * np.cos(frame)
    contrast[10:13] = np.nan
    return Trace(first, contrast, 1e-3, turn, 3, (turn - 80, turn + 60), 0.0, -0.004)


def test_the_step_is_drawn_where_it_was_fitted() -> None:
    step = trace_data(_trace())["step"]
    assert step["frame"] == [170, 250, 250, 310]
    assert step["contrast"] == [0.0, 0.0, -4.0, -4.0]


def test_frames_that_were_left_out_interrupt_the_curve_and_means_stay_on_one_side() -> None:
    trace = replace(_trace(), contrast=np.where(np.arange(300) < 150, 0.0, -0.004))
    trace.contrast[10:13] = np.nan
    drawn = trace_data(trace)
    assert [k for k, value in enumerate(drawn["frames"]["contrast"]) if value is None] == [
        10,
        11,
        12,
    ]
    means = list(zip(drawn["means"]["frame"], drawn["means"]["contrast"], strict=True))
    assert {level for frame, level in means if frame < 250} == {0.0}
    assert {level for frame, level in means if frame > 250} == {-4.0}


@pytest.mark.parametrize("frames", [1, 2, 5, 600])
def test_any_length_can_be_drawn(frames: int) -> None:
    trace = Trace(0, np.full(frames, np.nan), 1e-3, 0, 0, (0, frames), 0.0, 0.0)
    assert trace_data(trace)["frames"]["contrast"] == [None] * frames
    known = replace(trace, contrast=np.linspace(-1, 1, frames))
    assert None not in trace_data(known)["frames"]["contrast"]
    assert "±" not in trace_words(known)
    assert "frame 250 ± 3" in trace_words(_trace())


def opened(address: str) -> Image.Image:
    return Image.open(io.BytesIO(base64.b64decode(address.removeprefix("data:image/png;base64,"))))


def test_a_clip_is_a_small_film() -> None:
    rng = np.random.default_rng(1)
    images = rng.normal(0, 1e-3, (13, 18, 21)).astype(np.float32)
    images[:, 3, 4] = np.nan
    images[:, 0, 0] = np.linspace(-1, 1, 13)
    scale = Scale(-3e-3, 3e-3, 4.0, "contrast")
    film = clip_shown(Clip(tuple(range(40, 53)), 80, images), scale, 46)
    assert len(film["image"]) < 15_000
    assert "80 frames over the 80 before them, from frame 40 on to 52" in film["told"]
    assert film["ratio"] == 21 / 18
    assert (film["frames"], film["still"]) == (13, 6)
    assert film["seconds"] == pytest.approx(13 * CLIP_MS / 1e3)
    with opened(film["image"]) as below_each_other:
        pixels = np.asarray(below_each_other.convert("RGBA")).reshape(13, 18, 21, 4)
    assert pixels[:, 0, 0, 0].tolist() == [0] * 6 + [pixels[6, 0, 0, 0]] + [255] * 6
    assert np.all(pixels[:, 3, 4, 3] == 0)  # no number: transparent
    assert np.count_nonzero(pixels[..., 3] == 0) == 13


def test_views_survive_the_disk_with_and_without_a_trace() -> None:
    views = with_traces(make_analysis(4)).views
    views = (views[0], replace(views[1], trace=None, clip=None), *views[2:])
    again = unpacked(packed(views), (EventView, Trace, Clip))
    for one, two in zip(views, again, strict=True):
        assert one.event == two.event
        for what in ("contrast", "model", "residual"):
            np.testing.assert_array_equal(getattr(one, what), getattr(two, what))
        if one.trace is None or one.clip is None:
            assert two.trace is two.clip is None
            continue
        assert two.trace is not None
        assert two.clip is not None
        np.testing.assert_array_equal(one.trace.contrast, two.trace.contrast)
        np.testing.assert_array_equal(one.clip.contrast, two.clip.contrast)
        nothing = np.empty(0)
        for left, right in ((one.trace, two.trace), (one.clip, two.clip)):
            assert repr(replace(left, contrast=nothing)) == repr(replace(right, contrast=nothing))
    assert unpacked(packed(()), ()) == ()


def test_the_page_holds_trace_and_clip_and_a_figure_the_trace() -> None:
    plain = make_analysis(3)
    table = event_table(plain)
    bare, full = (event_details(one, table) for one in (plain, with_traces(plain)))
    assert all(set(detail) == {"strip", "scales"} for detail in bare.values())
    for detail in full.values():
        assert {"trace", "told", "clip"} < set(detail)
        assert len(json.dumps(detail)) < 25_000
    labels = {axes.get_xlabel() for axes in Result(with_traces(plain)).view(0).axes}
    assert "frame" in labels


def test_images_keep_their_shades() -> None:
    view = make_analysis(1).views[0]
    ramp = np.tile(np.linspace(-1, 1, 64), (4, 1))
    ramp[0, 0] = np.nan
    view = EventView(0, 0, 0, ramp, ramp, 4 * ramp)
    analysis = replace(make_analysis(1), views=(view,))
    (detail,) = event_details(analysis, event_table(analysis)).values()
    with opened(detail["strip"]) as picture:
        pixels = np.asarray(picture.convert("RGBA"))
    assert pixels.shape == (4, 3 * 64 + 4, 4)
    grey = pixels[1, :64]
    assert np.all(np.diff(grey[:, 0].astype(int)) >= 0)
    assert (grey[0, 0], grey[-1, 0]) == (0, 255)
    assert np.all(grey[:, 0] == grey[:, 1])
    assert pixels[0, 0, 3] == pixels[0, 64, 3] == 0  # no number, and the gap
    assert pixels[1, -1, 0] > pixels[1, -1, 2]  # above the model: warm
