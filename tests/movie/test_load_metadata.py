"""What a movie, drivers' names in it, and texts beside it say of a recording, or leave unknown."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from small_files import refused
from tiff_files import ASCII, RATIONAL, SHORT, movie, write_micro_manager, write_pages

from iscat_analysis.camera import resolve_metadata
from iscat_analysis.camera.learned import learn_camera
from iscat_analysis.config import CameraConfig, configure
from iscat_analysis.errors import DataError
from iscat_analysis.movie import measure_clock, open_stack
from iscat_analysis.records import StackMetadata

FRAMES = 5
INTERVAL_MS = 5.02
OME = (
    '<?xml version="1.0" encoding="UTF-8"?>'
    '<OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06">'
    '<Image ID="Image:0"><Pixels ID="Pixels:0" DimensionOrder="XYZCT" Type="uint16" SizeX="14" '
    'SizeY="10" SizeZ="1" SizeC="1" SizeT="5" {pixels}>{body}</Pixels></Image>{more}</OME>'
)


def described(
    path: Path, text: str, *, frames: int = FRAMES, resolution: tuple | None = None
) -> Path:
    tags: dict = {270: (ASCII, text)} if text else {}
    if resolution is not None:
        (x, y), unit = resolution
        tags |= {282: (RATIONAL, x), 283: (RATIONAL, y), 296: (SHORT, [unit])}
    return write_pages(path, movie(frames), page_tags={0: tags})


def ome(path: Path, pixels: str = "", body: str = "", more: str = "") -> Path:
    return described(path, OME.format(pixels=pixels, body=body, more=more))


def planes(times_ms: dict[int, float], more: str = "") -> str:
    return "".join(
        f'<Plane TheT="{t}" TheZ="0" TheC="0" DeltaT="{time}" DeltaTUnit="ms" {more}/>'
        for t, time in times_ms.items()
    )


def imagej(path: Path, lines: str) -> StackMetadata:
    return metadata(described(path, f"ImageJ=1.53t\nimages=5\n{lines}\n"))


def metadata(path: Path) -> StackMetadata:
    with open_stack(path) as stack:
        return stack.metadata


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "m.tif"


# --- OME ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "unit"),
    [
        ("0.0844", ""),
        ("0.0844", "µm"),
        ("0.0844", "μm"),
        ("84.4", "nm"),
        ("8.44e-5", "mm"),
        ("844", "Å"),
    ],
)
def test_ome_pixel_size(path: Path, size: str, unit: str) -> None:
    units = f'PhysicalSizeXUnit="{unit}" PhysicalSizeYUnit="{unit}"' if unit else ""
    found = metadata(ome(path, f'PhysicalSizeX="{size}" PhysicalSizeY="{size}" {units}'))
    assert found.pixel_size_nm == pytest.approx(84.4, rel=1e-12)
    assert found.source == "ome"


@pytest.mark.parametrize(
    "attributes",
    [
        'PhysicalSizeX="0"',
        'PhysicalSizeX="-1"',
        'PhysicalSizeX="nan"',
        'PhysicalSizeX="inf"',
        'PhysicalSizeX="large"',
        'PhysicalSizeX="84" PhysicalSizeXUnit="pixel"',
        'TimeIncrement="0"',
        'TimeIncrement="-5"',
        'TimeIncrement="5" TimeIncrementUnit="fortnight"',
    ],
)
def test_ome_nonsense_is_ignored(path: Path, attributes: str) -> None:
    assert metadata(ome(path, attributes)) == StackMetadata()


def test_ome_timing(path: Path) -> None:
    body = planes({4: 20.0, 0: 0.0, 2: 10.0}, 'ExposureTime="0.004"')
    found = metadata(ome(path, body=body))
    assert found.frame_rate_hz == pytest.approx(200)
    assert found.exposure_ms == pytest.approx(4)
    assert found.displayed_hz is None


@pytest.mark.parametrize(("increment", "said"), [("10", True), ("5.01", False)])
def test_times_of_ome_planes_are_preferred_to_the_interval_that_was_set(
    path: Path, increment: str, said: bool
) -> None:
    body, pixels = planes({t: 5.0 * t for t in range(5)}), f'TimeIncrement="{increment}"'
    with open_stack(ome(path, f'{pixels} TimeIncrementUnit="ms"', body)) as m:
        assert m.metadata.frame_rate_hz == pytest.approx(200, rel=0.01)
        assert [("100 Hz" in note, "DeltaT" in note) for note in m.notes] == [(True, True)] * said
    with open_stack(ome(path, f'{pixels} TimeIncrementUnit="ms"')) as m:
        assert m.metadata.frame_rate_hz == pytest.approx(1e3 / float(increment))
        assert not m.notes


def test_pixels_must_be_square(path: Path) -> None:
    refused(ome(path, 'PhysicalSizeX="0.084" PhysicalSizeY="0.085"'), "84 nm in x and 85 nm in y")


@pytest.mark.parametrize(
    "prolog",
    ['<!DOCTYPE OME [<!ENTITY a "aaaa">]>', "<!DOCTYPE OME SYSTEM 'file:///etc/hostname'>"],
)
def test_ome_document_types_are_refused(path: Path, prolog: str) -> None:
    text = OME.format(pixels="", body="", more="").replace("?>", "?>" + prolog)
    refused(described(path, text), "document type")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("</OME>", "", "damaged"),
        ('SizeT="5"', 'SizeT="five"', "SizeT is 'five'"),
        ('SizeT="5"', "", "SizeT, SizeZ or SizeC"),
        ('SizeT="5"', 'SizeT="9"', "describes 9 frames but the file holds 5"),
        ('SizeT="5"', 'SizeT="2"', "describes 2 frames but the file holds 5"),
        ('SizeT="5"', f'SizeT="{10**15}"', "describes 1000000000000000 frames"),
        ('SizeC="1"', 'SizeC="2"', "T (time) of length 5 and C (channel) of length 2"),
        ("<Image", '<BinaryOnly MetadataFile="a.ome.tif"/><Image', "one part of an OME set"),
    ],
)
def test_ome_that_does_not_fit_is_refused(path: Path, old: str, new: str, message: str) -> None:
    text = OME.format(pixels="", body="", more="")
    assert old in text
    refused(described(path, text.replace(old, new)), message)


def test_ome_orders_the_frames(path: Path) -> None:
    body = "".join(f'<TiffData FirstT="{t}" IFD="{4 - t}" PlaneCount="1"/>' for t in range(5))
    with open_stack(ome(path, body=body)) as stack:
        np.testing.assert_array_equal(stack.read(0, 5), movie(5)[::-1])
        np.testing.assert_array_equal(stack.read(1, 3), movie(5)[::-1][1:3])


@pytest.mark.parametrize(
    "body",
    [
        '<TiffData IFD="0" PlaneCount="4"/>',
        '<TiffData IFD="0" PlaneCount="6"/>',
        '<TiffData FirstT="0" IFD="0"/><TiffData FirstT="1" IFD="0"/>',
    ],
)
def test_ome_must_cover_every_image_once(path: Path, body: str) -> None:
    refused(ome(path, body=body), "OME-XML")


def test_ome_sets_without_their_files_are_refused(path: Path) -> None:
    body = "".join(
        f'<TiffData FirstT="{t}" IFD="0"><UUID FileName="part{t}.ome.tif">urn:uuid:{t}</UUID>'
        "</TiffData>"
        for t in range(5)
    )
    refused(ome(path, body=body), "one of 5 files of a movie, of which part0.ome.tif")


def test_a_renamed_ome_file_is_read(path: Path) -> None:
    body = (
        '<TiffData IFD="0" PlaneCount="5"><UUID FileName="other.ome.tif">urn:uuid:1</UUID>'
        "</TiffData>"
    )
    with open_stack(ome(path, body=body)) as stack:
        assert stack.shape == (5, 10, 14)


def test_ome_series_are_refused(path: Path) -> None:
    more = OME[OME.index("<Image") : OME.index("{more}")].format(pixels="", body="")
    refused(ome(path, more=more), "2 image series")


INSTRUMENT = (
    '<Instrument ID="Instrument:0"><Objective ID="Objective:0" LensNA="1.3" '
    'NominalMagnification="60"/>{second}</Instrument>'
)
SECOND = '<Objective ID="Objective:1" LensNA="0.75" NominalMagnification="20"/>'


def with_instrument(path: Path, settings: str = "", second: str = "", channel: str = "") -> Path:
    text = OME.format(pixels="", body=channel, more=INSTRUMENT.format(second=second))
    return described(path, text.replace("<Pixels", f"{settings}<Pixels"))


@pytest.mark.parametrize(
    ("settings", "second", "found"),
    [
        ("", "", (1.3, 60)),
        ('<ObjectiveSettings ID="Objective:1"/>', SECOND, (0.75, 20)),
        ("", SECOND, (None, None)),  # which of the two, nobody says
        ('<ObjectiveSettings ID="Objective:7"/>', SECOND, (None, None)),
    ],
)
def test_ome_objective(path: Path, settings: str, second: str, found: tuple) -> None:
    read = metadata(with_instrument(path, settings, second))
    assert (read.na, read.magnification) == found


@pytest.mark.parametrize(
    ("channels", "wavelength_nm"),
    [
        (['ExcitationWavelength="532"'], 532),
        (['ExcitationWavelength="0.532" ExcitationWavelengthUnit="µm"'], 532),
        (['ExcitationWavelength="445"', 'ExcitationWavelength="445"'], 445),
        (['ExcitationWavelength="445"', 'ExcitationWavelength="532"'], None),
        (['ExcitationWavelength="532" ExcitationWavelengthUnit="Hz"'], None),
        (['ExcitationWavelength="5"'], None),
        (['EmissionWavelength="600"'], None),  # of fluorescence, and not of what illuminates
    ],
)
def test_ome_wavelength(path: Path, channels: list[str], wavelength_nm: float | None) -> None:
    body = "".join(f'<Channel ID="Channel:0:{k}" {c}/>' for k, c in enumerate(channels))
    found = metadata(ome(path, body=body)).wavelength_nm
    assert found == (wavelength_nm if wavelength_nm is None else pytest.approx(wavelength_nm))


def test_ome_keeps_the_conversion_of_hamamatsu(path: Path) -> None:
    """As Bio-Formats copies it; Gain and Offset of a Detector have no unit and are not read."""
    pair = (
        "<OriginalMetadata><Key>Cam-CONVERSION FACTOR {}</Key><Value>{}</Value></OriginalMetadata>"
    )
    pairs = "".join(pair.format(*one) for one in (("COEFF", "0.46"), ("OFFSET", "100")))
    notes = f"<StructuredAnnotations><XMLAnnotation><Value>{pairs}</Value></XMLAnnotation>"
    found = metadata(ome(path, more=f"{notes}</StructuredAnnotations>"))
    assert (found.gain_e_per_adu, found.offset_adu) == (0.46, 100)
    slider = '<Instrument><Detector ID="Detector:0" Gain="4" Offset="7"/></Instrument>'
    assert metadata(ome(path, more=slider)) == StackMetadata()


# --- what is read is used --------------------------------------------------------------------


def test_optics_of_the_file_take_the_place_of_defaults_only(path: Path) -> None:
    channel = '<Channel ID="Channel:0:0" ExcitationWavelength="445"/>'
    read = metadata(with_instrument(path, channel=channel))
    used, notes = resolve_metadata(configure({"camera.pixel_size_nm": 84.4}), read)
    assert (used.optics.na, used.optics.wavelength_nm) == (1.3, 445)
    assert [note.text.split(",")[0] for note in notes] == [
        "the wavelength is 445 nm",
        "the NA is 1.3",
    ]
    given = configure({"camera.pixel_size_nm": 84.4, "optics.na": 1.4})
    given = configure(given, settings={"optics.wavelength_nm": 450.0})
    used, notes = resolve_metadata(given, read)
    assert (used.optics.na, used.optics.wavelength_nm) == (1.4, 450)
    assert len(notes) == 1
    assert "the NA is 1.4 in the configuration (optics.na) but 1.3 in" in notes[0].text


def test_a_default_stays_one_when_other_keys_change() -> None:
    changed = configure(configure(), settings={"camera.pixel_size_nm": 84.4})
    used, _ = resolve_metadata(changed, StackMetadata(na=1.3, source="ome"))
    assert used.optics.na == 1.3


def test_an_aperture_that_the_oil_does_not_admit_is_refused() -> None:
    with pytest.raises(DataError, match=r"ome metadata do not suit.*below n_immersion"):
        resolve_metadata(
            configure({"camera.pixel_size_nm": 84.4}), StackMetadata(na=1.7, source="ome")
        )


# --- ImageJ ------------------------------------------------------------------------------------


@pytest.mark.parametrize("unit", ["micron", "um", "µm", "\\u00B5m", "nm"])
def test_imagej(path: Path, unit: str) -> None:
    per_unit = [10_000, 844_000] if unit == "nm" else [10_000, 844]
    text = f"ImageJ=1.53t\nimages=5\nframes=5\nunit={unit}\nfinterval=0.005\nfps=7\n"
    found = metadata(described(path, text, resolution=((per_unit, per_unit), 1)))
    assert found.pixel_size_nm == pytest.approx(84.4, rel=1e-12)
    assert found.frame_rate_hz == pytest.approx(200)
    assert found.source == "imagej"


@pytest.mark.parametrize(
    ("lines", "rate"),
    [
        ("finterval=5\ntunit=ms", 200),
        ("finterval=0.005", 200),
        ("finterval=5000\ntunit=\\u00B5s", 200),
        ("finterval=5000\ntunit=\\u00b5sec", 200),
        ("finterval=5000\ntunit=us\nfps=7", 200),
        ("finterval=0.5\ntunit=min", 1 / 30),
        ("finterval=5\ntunit=fortnights", None),
        ("finterval=0\nfps=0", None),
        ("fps=7.0", None),
    ],
)
def test_imagej_timing(path: Path, lines: str, rate: float | None) -> None:
    found = imagej(path, lines)
    assert found.frame_rate_hz == (rate if rate is None else pytest.approx(rate))


@pytest.mark.parametrize(
    ("lines", "settings", "said"),
    [
        ("fps=7.0", {"fit.mode": "track"}, True),
        ("fps=7.0\nfinterval=0.005", {"fit.mode": "track"}, False),
        ("fps=7.0", {"fit.mode": "mass"}, False),
    ],
)
def test_the_speed_of_display_is_never_the_frame_rate(
    path: Path, lines: str, settings: dict[str, str], said: bool
) -> None:
    read = imagej(path, lines)
    config = configure({"camera.pixel_size_nm": 84.4, **settings})
    used, notes = resolve_metadata(config, read)
    assert used.camera.frame_rate_hz == read.frame_rate_hz
    assert [note.code for note in notes] == ["displayed-rate"] * said


@pytest.mark.parametrize("unit", ["pixel", "inch", "", "cm"])
def test_imagej_without_calibration(path: Path, unit: str) -> None:
    text = f"ImageJ=1.53t\nimages=5\nunit={unit}\n"
    resolution = (([72, 1], [72, 1]), 1)
    assert metadata(described(path, text, resolution=resolution)).pixel_size_nm is None


def test_imagej_as_tifffile_writes_it(path: Path) -> None:
    options = {"axes": "TYX", "unit": "um", "finterval": 0.01}
    tifffile.imwrite(path, movie(5), imagej=True, resolution=(1 / 0.05, 1 / 0.05), metadata=options)
    found = metadata(path)
    assert found.pixel_size_nm == pytest.approx(50, rel=1e-6)
    assert found.frame_rate_hz == pytest.approx(100)


@pytest.mark.parametrize(
    ("lines", "gain", "offset"),
    [
        ("cf=0\nc0=-46.0\nc1=0.46\nvunit=electrons", 0.46, 100),
        ("cf=0\nc0=-46.0\nc1=0.46\nvunit=e-", 0.46, 100),
        ("cf=0\nc0=-32768.0\nc1=1.0\nvunit=Gray Value", None, 32768),
        ("cf=0\nc0=-46.0\nc1=0.46\nvunit=OD", None, None),
        ("cf=3\nc0=-46.0\nc1=0.46\nvunit=electrons", None, None),  # an exponential
        ("cf=0\nc0=-46.0\nc1=-0.46\nvunit=electrons", None, None),
        ("cf=0\nc0=nan\nc1=0.46\nvunit=electrons", None, None),
        ("cf=0\nc1=0.46\nvunit=electrons", None, None),
    ],
)
def test_imagej_counts(path: Path, lines: str, gain: float | None, offset: float | None) -> None:
    found = imagej(path, lines)
    assert found.gain_e_per_adu == gain
    assert found.offset_adu == (None if offset is None else pytest.approx(offset))


def test_the_zero_of_signed_numbers_makes_the_gain_right(path: Path) -> None:
    """2 e per count; without the line, 32768 counts would be light and the gain far off."""
    light = np.random.default_rng(4).poisson(4000.0, (FRAMES * 8, 48, 48))
    counts = (light / 2 + 32768).round().astype("uint16")
    text = "ImageJ=1.53t\nimages=40\nframes=40\n{}"
    learned = []
    for line in ("cf=0\nc0=-32768.0\nc1=1.0\nvunit=Gray Value\n", ""):
        tags: dict = {270: (ASCII, text.format(line))}
        write_pages(path, counts, page_tags={0: tags})
        with open_stack(path) as stack:
            found = learn_camera(stack, CameraConfig(), (0, 40), metadata=stack.metadata)
        learned.append(found.numbers)
    gain = learned[0]["gain_e_per_adu"]
    assert abs(gain.value - 2) < 4 * gain.se
    assert gain.se < 0.05
    assert learned[0]["offset_adu"].source == "metadata"
    assert learned[1]["gain_e_per_adu"].value > 10


# --- Micro-Manager -----------------------------------------------------------------------------


def frame_metadata(**fields: object) -> list[dict[str, object]]:
    return [{"Frame": k, "ElapsedTime-ms": 40.0 + 12.5 * k, **fields} for k in range(FRAMES)]


def test_micro_manager(path: Path) -> None:
    fields = {"PixelSizeUm": 0.0844, "Exposure-ms": 10, "Interval_ms": 20}
    with open_stack(write_micro_manager(path, movie(FRAMES), frame_metadata(**fields))) as stack:
        found, notes = stack.metadata, stack.notes
    assert found.pixel_size_nm == pytest.approx(84.4)
    assert found.exposure_ms == 10
    assert found.frame_rate_hz == pytest.approx(80)  # frames came every 12.5 ms
    assert found.source == "micromanager"
    assert "not 50 Hz, by its Interval_ms" in notes[0]


@pytest.mark.parametrize("told", ["ElapsedTime-ms", "FrameIndex", "both"])
@pytest.mark.parametrize("how", ["pairs", "reversed", "late"])
def test_pages_are_sorted_by_their_times(path: Path, how: str, told: str) -> None:
    data, n = movie(12), np.arange(12)
    order = {"pairs": n.reshape(-1, 2)[:, ::-1].ravel(), "reversed": n[::-1], "late": (n + 6) % 12}
    kept = np.delete(n, 4) if told == "ElapsedTime-ms" else n  # frame 4 was dropped
    pages = [int(k) for k in order[how] if k in kept]
    fields = [{"ElapsedTime-ms": 40 + 5.0 * k, "FrameIndex": k} for k in pages]
    if told != "both":
        fields = [{told: page[told]} for page in fields]
    with open_stack(write_micro_manager(path, data[pages], fields)) as stack:
        np.testing.assert_array_equal(stack.read(0, len(kept)), data[kept])
        np.testing.assert_array_equal(stack.read(3, 8), data[kept[3:8]])
        assert stack.metadata.ticks == (tuple(kept.tolist()) if len(kept) < 12 else None)
        if told != "FrameIndex":
            assert stack.metadata.frame_rate_hz == pytest.approx(200, rel=1e-3)
        assert sum(f"of the file's {len(kept)} images" in note for note in stack.notes) == 1
    with open_stack(
        write_micro_manager(path, data[kept], sorted(fields, key=lambda page: [*page.values()]))
    ) as stack:
        assert not stack.notes


def test_times_that_two_pages_share_leave_them_in_the_order_of_their_numbers(path: Path) -> None:
    fields = [{"ElapsedTime-ms": 5 * (k // 2), "FrameIndex": k ^ 1} for k in range(6)]
    with open_stack(write_micro_manager(path, movie(6), fields)) as stack:
        np.testing.assert_array_equal(stack.read(0, 6), movie(6)[[1, 0, 3, 2, 5, 4]])


@pytest.mark.parametrize("cameras", [1, 2])
def test_micro_manager_has_the_conversion_of_hamamatsu(path: Path, cameras: int) -> None:
    """Of one camera; of two it is not known which one recorded."""
    fields = {}
    for k in range(cameras):
        fields[f"Cam{k}-CONVERSION FACTOR COEFF"] = "0.46"
        fields[f"Cam{k}-CONVERSION FACTOR OFFSET"] = {"PropVal": "100"}
    found = metadata(write_micro_manager(path, movie(FRAMES), frame_metadata(**fields)))
    given = (0.46, 100.0) if cameras == 1 else (None, None)
    assert (found.gain_e_per_adu, found.offset_adu) == given


@pytest.mark.parametrize("interval", [0, 5])
def test_micro_manager_falls_back_on_time_stamps(path: Path, interval: float) -> None:
    fields = {"PixelSizeUm": 0, "Exposure-ms": {"PropVal": "10"}, "Interval_ms": interval}
    found = metadata(write_micro_manager(path, movie(FRAMES), frame_metadata(**fields)))
    assert found.pixel_size_nm is None
    assert found.exposure_ms == 10
    assert found.frame_rate_hz == pytest.approx(80)


def test_ome_comes_before_micro_manager(path: Path) -> None:
    text = OME.format(pixels='PhysicalSizeX="0.05"', body="", more="")
    fields = {"PixelSizeUm": 0.0844, "Exposure-ms": 10}
    found = metadata(write_micro_manager(path, movie(FRAMES), frame_metadata(**fields), text))
    assert found.pixel_size_nm == pytest.approx(50)
    assert found.exposure_ms == 10
    assert found.source == "ome+micromanager"


def test_damaged_micro_manager_metadata_is_ignored(path: Path) -> None:
    broken = write_pages(path, movie(FRAMES), tags={51123: (ASCII, "{broken")})
    assert metadata(broken) == StackMetadata()


# --- plain TIFF --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("pixels_per_unit", "unit", "pixel_size_nm"),
    [
        (1e7 / 84.4, 3, 84.4),
        (2.54e7 / 84.4, 2, 84.4),
        (1e7 / 4.9, 3, None),
        (1e7 / 5100, 3, None),
        (300, 2, None),
        (1e7 / 84.4, 1, None),
    ],
)
def test_resolution_tags(
    path: Path, pixels_per_unit: float, unit: int, pixel_size_nm: float | None
) -> None:
    ratio = [round(pixels_per_unit * 100), 100]
    found = metadata(described(path, "", resolution=((ratio, ratio), unit)))
    if pixel_size_nm is None:
        assert found == StackMetadata()
    else:
        assert found.pixel_size_nm == pytest.approx(pixel_size_nm, rel=1e-6)
        assert found.source == "tiff"


def test_a_resolution_of_zero_is_ignored(path: Path) -> None:
    assert metadata(described(path, "", resolution=(([0, 1], [1, 0]), 3))) == StackMetadata()


# --- frames that the camera dropped ------------------------------------------------------------


def clock(kept: NDArray[np.int64], late_ms: float, seed: int) -> dict[int, float]:
    """Make up when a computer received frames of a camera [s], in whole ms and somewhat late."""
    late = np.random.default_rng(seed).exponential(late_ms, kept.size) if late_ms else 0.0
    times_ms = np.maximum.accumulate(np.floor(INTERVAL_MS * kept + late))
    return dict(enumerate((times_ms / 1e3).tolist()))


@pytest.mark.parametrize("late_ms", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("share", [0.01, 0.1, 0.3])
@pytest.mark.parametrize("seed", range(5))
def test_times_tell_which_frames_are_missing(share: float, late_ms: float, seed: int) -> None:
    kept = np.flatnonzero(np.random.default_rng(seed).random(3000) >= share)
    rate, ticks = measure_clock(clock(kept, late_ms, seed=2))
    assert rate == pytest.approx(1e3 / INTERVAL_MS, rel=1e-4)
    assert ticks is not None
    wrong = np.diff(ticks) != np.diff(kept)  # where one was late by more than half an interval
    assert np.mean(wrong) < 0.05


@pytest.mark.parametrize("late_ms", [0.0, 0.3, 1.0, 20.0])
def test_late_frames_are_not_missing(late_ms: float) -> None:
    """Times without order tell a mean rate alone."""
    rate, ticks = measure_clock(clock(np.arange(3000), late_ms, seed=2))
    assert rate == pytest.approx(1e3 / INTERVAL_MS, rel=1e-4 if late_ms < 2 else 0.02)
    assert ticks is None


def test_a_burst_of_missing_frames() -> None:
    kept = np.r_[0:100, 140:300]
    rate, ticks = measure_clock(clock(kept, 0.0, seed=0))
    assert ticks == tuple(kept.tolist())
    assert rate == pytest.approx(1e3 / INTERVAL_MS, rel=1e-3)


def test_times_that_run_backwards_tell_a_mean_rate_alone() -> None:
    assert measure_clock({0: 0.0, 1: 0.02, 2: 0.01, 3: 0.03}) == (pytest.approx(100), None)
    assert measure_clock({0: 1.0, 1: 1.0, 2: 1.0}) == (None, None)
    assert measure_clock({}) == (None, None)


def test_missing_frames_of_ome_and_micro_manager(path: Path) -> None:
    times = [0, 5, 10, 25, 30]
    pixels = 'TimeIncrement="6" TimeIncrementUnit="ms"'
    stamps = [{"ElapsedTime-ms": time, "Interval_ms": 6} for time in times]
    found = [metadata(ome(path, pixels, planes(dict(enumerate(times)))))]
    found.append(metadata(write_micro_manager(path, movie(FRAMES), stamps)))
    for one in found:
        assert one.ticks == (0, 1, 2, 5, 6)
        assert one.frame_rate_hz == pytest.approx(200)


# --- drivers' names, and texts beside the movie --------------------------------------------------

SOLIS = """\
Date and Time:\tTue Nov 24 10:11:12 2026
Software Version:\t4.32.30065.0
Acquisition Mode:\tKinetic
Exposure Time (secs):\t0.00400
Kinetic Cycle Time (secs):\t0.00500
Horizontal binning:\t2
Pre-Amplifier Gain:\t4x
"""
PYLON = """\
# {05D8C294-F295-4dfb-9D01-096BD04049F4}
# GenApi persistence file (version 3.1.0)
ExposureTime\t4000.0
Gain\t6.00000
BlackLevel\t4.00000
AcquisitionFrameRateEnable\t{on}
AcquisitionFrameRate\t200.0
BinningHorizontal\t1
"""
PYLABLIB = """\
cam/data_dimensions\t(6, 5)
cam/frame_timings\t(4.000000000000E-03, 5.000000000000E-03)
save/path\tD:/data/movie.tif
"""
OWN = {
    "camera": {"ExposureTime": 4000.0, "SensorPixelWidth": 5.04, "BinningHorizontal": 1},
    "optics": {"magnification": 60, "wavelength_nm": 445, "na": 1.3, "gain_e_per_adu": 0.5},
}


def read(folder: Path, beside: dict[str, str]) -> StackMetadata:
    path = folder / "movie.tif"
    tifffile.imwrite(path, movie(5), photometric="minisblack", metadata={"axes": "TYX"})
    for name, text in beside.items():
        (folder / name).write_text(text, encoding="utf-8")
    with open_stack(path) as stack:
        return stack.metadata


@pytest.mark.parametrize(
    ("name", "text", "found"),
    [
        ("movie.txt", SOLIS, {"exposure_ms": 4, "frame_rate_hz": 200, "binning": 2}),
        ("movie.pfs", PYLON.replace("{on}", "1"), {
            "exposure_ms": 4, "frame_rate_hz": 200, "binning": 1,
        }),
        ("movie.pfs", PYLON.replace("{on}", "0"), {"exposure_ms": 4, "binning": 1}),
        ("movie_settings.dat", PYLABLIB, {"exposure_ms": 4, "frame_rate_hz": 200}),
        ("movie.json", json.dumps(OWN), {
            "exposure_ms": 4, "binning": 1, "magnification": 60, "wavelength_nm": 445, "na": 1.3,
            "pixel_size_nm": 84, "gain_e_per_adu": 0.5,
        }),
        ("movie.json", json.dumps({"ExposureTime": 0.004, "StackCycleTime": 0.005}), {
            "exposure_ms": 4, "frame_rate_hz": 200,
        }),
    ],
)  # fmt: skip
def test_a_text_beside_the_movie(tmp_path: Path, name: str, text: str, found: dict) -> None:
    """A gain in decibels, or the factor of an amplifier, is not taken for electrons per count."""
    said = read(tmp_path, {name: text})
    for key in StackMetadata.__dataclass_fields__:
        expected = found.get(key, name if key == "source" else None)
        assert getattr(said, key) == (pytest.approx(expected) if key in found else expected), key


@pytest.mark.parametrize(
    "text", ["", "{broken", "[" * 5000, '{"exposure_ms": -4, "na": 7, "binning": "none"}',
             "exposure_ms = nan", "Gain: 4\nlaser 2"],
)  # fmt: skip
def test_what_says_nothing_is_left_alone(tmp_path: Path, text: str) -> None:
    assert read(tmp_path, {"movie.json": text, "movie.txt": text}) == StackMetadata()


def test_the_file_itself_comes_first(tmp_path: Path) -> None:
    path = tmp_path / "movie.tif"
    tifffile.imwrite(
        path, movie(5), imagej=True, resolution=(20.0, 20.0), metadata={"axes": "TYX", "unit": "um"}
    )
    (tmp_path / "movie.json").write_text('{"pixel_size_nm": 84, "exposure_ms": 4}')
    with open_stack(path) as stack:
        said = stack.metadata
    assert (said.pixel_size_nm, said.exposure_ms) == (pytest.approx(50, rel=1e-6), 4)
    assert said.source == "imagej+movie.json"


def test_photometrics_and_andor_in_micro_manager(tmp_path: Path) -> None:
    fields = {
        "Prime-Actual Gain e/ADU": {"PropVal": "0.87"}, "Prime-Binning": "2x2",
        "Prime-ActualInterval-ms": "5.0", "Prime-Gain": "3", "Prime-Pre-Amp-Gain": "Gain 2",
    }  # fmt: skip
    frames = [{"Frame": k, **fields} for k in range(5)]
    with open_stack(write_micro_manager(tmp_path / "m.tif", movie(5), frames)) as stack:
        said = stack.metadata
    assert (said.gain_e_per_adu, said.offset_adu, said.binning) == (0.87, None, 2)
    assert said.frame_rate_hz == pytest.approx(200)


def test_metadata_stay_with_what_is_made_of_a_movie(tmp_path: Path) -> None:
    path = tmp_path / "movie.tif"
    tifffile.imwrite(path, movie(9), photometric="minisblack", metadata={"axes": "TYX"})
    (tmp_path / "movie.txt").write_text(SOLIS)
    with open_stack(path) as stack:
        one = stack.channel((2, 1))
        assert one.metadata.exposure_ms == 4
        assert one.metadata.frame_rate_hz == pytest.approx(100)  # every other frame
        assert one.shape[0] == 4
        np.testing.assert_array_equal(one.read(1, 3), movie(9)[[3, 5]])
        assert one.read(2, 2).shape == (0, 10, 14)
