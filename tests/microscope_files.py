"""Files of Nikon and Zeiss: written as their formats say, and what stands in for their readers."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

_ND2_CHUNK = struct.Struct("<IIQ")
_ND2_MAGIC = 0x0ABECEDA
_ND2_TYPES = {int: "lx_uint32", float: "double", str: "CLxStringW"}


def write_nd2(
    path: Path, counts: NDArray[Any], times_ms: Sequence[float], *, lost: Sequence[int] = ()
) -> Path:
    """Write version 2 of Nikon's format, chunks and a map of them, without frames that are lost."""
    frames, rows, columns = counts.shape
    attributes = {
        "uiWidth": columns, "uiWidthBytes": 2 * columns, "uiHeight": rows, "uiComp": 1,
        "uiBpcInMemory": 16, "uiBpcSignificant": 16, "uiSequenceCount": frames, "eCompression": 2,
    }  # fmt: skip
    plane = {
        "uiCompCount": 1, "uiSampleIndex": 0, "sDescription": "Mono", "uiColor": 255,
        "pFluorescentProbe": {"m_sName": "none", "m_ExcitationSpectrum": {"uiCount": 0}},
    }  # fmt: skip
    picture = {
        "dCalibration": 0.0844, "bCalibrated": 1, "dAspect": 1.0, "dTimeMSec": 0.0,
        "dObjectiveNA": 1.42, "dObjectiveMag": 60.0,
        "sPicturePlanes": {"uiCount": 1, "uiSampleCount": 1, "sPlaneNew": {"a0": plane}},
    }  # fmt: skip
    loop = {"uiCount": frames, "dStart": 0.0, "dPeriod": 5.0, "dDuration": 5.0 * frames}
    chunks = {
        b"ImageAttributes!": _variant({"SLxImageAttributes": attributes}),
        b"ImageMetadataSeq|0!": _variant({"SLxPictureMetadata": picture}),
        b"ImageMetadata!": _variant({"SLxExperiment": {"eType": 1, "uLoopPars": loop}}),
        b"CustomData|AcqTimesCache!": np.array(times_ms, "<f8").tobytes(),
    }
    head = _ND2_CHUNK.pack(_ND2_MAGIC, 32, 64) + b"ND2 FILE SIGNATURE CHUNK NAME01!"
    file, places = bytearray(head + b"Ver2.1".ljust(64, b"\0")), {}
    for number, frame in enumerate(counts):
        if number not in lost:
            time = struct.pack("<d", times_ms[number])
            chunks[b"ImageDataSeq|%d!" % number] = time + frame.astype("<u2").tobytes()
    for name, data in chunks.items():
        room = name.ljust(4072, b"\0") if name.startswith(b"ImageDataSeq") else name
        places[name] = len(file), len(data)
        file += _ND2_CHUNK.pack(_ND2_MAGIC, len(room), len(data)) + room + data
    listed = b"".join(name + struct.pack("<QQ", *place) for name, place in places.items())
    listed += b"ND2 CHUNK MAP SIGNATURE 0000001!" + struct.pack("<Q", len(file))
    file += _ND2_CHUNK.pack(_ND2_MAGIC, 32, len(listed)) + b"ND2 FILEMAP SIGNATURE NAME 0001!"
    path.write_bytes(bytes(file) + listed)
    return path


def _variant(values: Mapping[str, Any]) -> bytes:
    def tag(name: str, value: Any) -> str:
        if isinstance(value, dict):
            inside = "".join(tag(*each) for each in value.items())
            return f'<{name} runtype="CLxListVariant">{inside}</{name}>'
        return f'<{name} runtype="{_ND2_TYPES[type(value)]}" value="{value}"/>'

    inside = "".join(tag(*each) for each in values.items())
    return f'<?xml version="1.0"?><variant version="1.0">{inside}</variant>'.encode()


class StandInForNd2(ModuleType):
    """What `open_nd2` uses of the package nd2, for one movie."""

    def __init__(self, counts: NDArray[Any], times_ms: Sequence[float], **said: Any) -> None:
        super().__init__("nd2")
        self.counts, self.times_ms, self.closed = counts, times_ms, False
        self.dtype = counts.dtype
        self.sizes = dict(zip("TYX", counts.shape, strict=True))
        self.attributes = SimpleNamespace(sequenceCount=len(counts), compressionType=None)
        lens = SimpleNamespace(objectiveNumericalAperture=1.42, objectiveMagnification=60.0)
        self.metadata = SimpleNamespace(channels=[SimpleNamespace(microscope=lens)])
        vars(self).update(said)

    def ND2File(self, path: str) -> StandInForNd2:  # noqa: N802
        if not Path(path).read_bytes().endswith(b"whole"):
            raise ValueError("Invalid ChunkMap signature\nb'' in file")
        return self

    def voxel_size(self) -> SimpleNamespace:
        return SimpleNamespace(x=0.0844, y=0.0844)

    def events(self, *, orient: str) -> dict[str, list[float]]:
        return {"Time [s]": [t / 1e3 for t in self.times_ms]} if orient == "list" else {}

    def read_frame(self, number: int) -> NDArray[Any]:
        return self.counts[number]

    def close(self) -> None:
        self.closed = True


class StandInForCzi(ModuleType):
    """What `open_czi` uses of the module pylibCZIrw.czi, for one movie."""

    def __init__(self, counts: NDArray[Any], **said: Any) -> None:
        super().__init__("pylibCZIrw.czi")
        self.counts, self.closed = counts, False
        frames, rows, columns = counts.shape
        ranges = {"T": frames, "Z": 1, "C": 1, "X": columns, "Y": rows}
        self.total_bounding_box = {axis: (3, 3 + size) for axis, size in ranges.items()}
        self.scenes_bounding_rectangle: dict[int, object] = {}
        self.pixel_types = {0: "Gray16"}
        interval = {"Interval": {"Start": "0", "Increment": "0.005"}}
        lens = {"LensNA": "1.42", "NominalMagnification": "60"}
        found = {
            "Information": {
                "Image": {"Dimensions": {"T": {"Positions": interval}}},
                "Instrument": {"Objectives": {"Objective": lens}},
            },
            "Scaling": {"Items": {"Distance": [{"@Id": a, "Value": "8.44e-08"} for a in "XY"]}},
        }
        self.metadata: Any = {"ImageDocument": {"Metadata": found}}
        vars(self).update(said)

    def CziReader(self, path: str) -> StandInForCzi:  # noqa: N802
        if not Path(path).read_bytes().endswith(b"whole"):
            raise RuntimeError("Illegal data detected")
        return self

    def read(self, *, plane: Mapping[str, int]) -> NDArray[Any]:
        return self.counts[plane["T"]][..., None]

    def close(self) -> None:
        self.closed = True
