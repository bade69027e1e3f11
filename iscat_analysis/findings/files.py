"""What a file says of its recording, where the configuration or the camera says something else."""

from __future__ import annotations

from iscat_analysis.findings.registry import Subject, makers

note, caution, fault = makers(Subject.CAMERA)

FILE_IMPLIES = caution("file-implies", "{text}", page="howto/tiff")
METADATA_DISAGREES = caution(
    "metadata-disagrees",
    "the {words} is {given:g}{unit} in the configuration ({key}) but {read:g}{unit} in the movie's "
    "{source} metadata; the configuration is used",
)
OPTICS_OF_FILE = caution(
    "optics-of-file",
    "the {words} is {read:g}{unit}, as in the movie's {source} metadata, and not {given:g}{unit}, "
    "which is the default of {key}",
)
DISPLAYED_RATE = caution(
    "displayed-rate",
    "the {shown_hz:g} frames per second in the file are the speed at which ImageJ shows the movie, "
    "which tells nothing of the camera, and are not used",
)
FRAMES_DROPPED = caution(
    "frames-dropped",
    "the camera dropped {frames}, by the times in the movie's {source} metadata; diffusion "
    "coefficients and rates count the time that passed",
)
COARSE_PIXELS = caution(
    "coarse-pixels",
    "a pixel of {pixel_nm:g} nm, as {where}, is larger than the spot of a particle is wide: about "
    "{spot_nm:.3g} nm, optics.wavelength_nm over twice optics.na, so that pictures are not "
    "resolved",
    "unless it was binned so far, give its size in the sample plane, as in "
    "camera.pixel_size_nm = 84.4",
)
AXES_SWAPPED = fault(
    "axes-swapped",
    "frames differ more from each other than neighbouring {lines} of one frame do ({times:.0f} "
    "times), as if time ran along its {lines}: the axes must be (t, y, x)",
    "export it again in this order",
)
BITS_PADDED = note(
    "bits-padded",
    "all counts are multiples of {step}, as where {bits} bits stand in the high bits of 16: a gain "
    "of a data sheet, per count of the camera, is to be divided by {step}, an offset multiplied; "
    "what the file's metadata say is taken so",
)
