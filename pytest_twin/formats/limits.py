"""Size limits of every reader, so that a hostile or damaged file cannot exhaust memory or time."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class PathLimits:
    """Bounds on a reference to a file."""

    reference_chars: int = 4096
    component_bytes: int = 255


@dataclass(frozen=True, slots=True)
class YamlLimits:
    """Bounds on a YAML file."""

    file_bytes: int = 4 * 2**20
    depth_levels: int = 32
    nodes_count: int = 200_000
    key_chars: int = 1024


@dataclass(frozen=True, slots=True)
class XmlLimits:
    """Bounds on an XML file: a URDF, an MJCF, a part of either."""

    file_bytes: int = 64 * 2**20
    depth_levels: int = 256
    elements_count: int = 500_000
    attributes_count: int = 5_000_000


@dataclass(frozen=True, slots=True)
class TraceLimits:
    """Bounds on a trace beside a spec: a few seconds of series, not a log."""

    file_bytes: int = 16 * 2**20
    rows_count: int = 200_000
    columns_count: int = 512
    heading_chars: int = 2048


@dataclass(frozen=True, slots=True)
class McapLimits:
    """Bounds on a recording: an hour of a humanoid at 1 kHz fits.

    The size of the file limits the decompressed content too, so that a small file cannot cost
    minutes. Joint states that never change compress 64 to 1 in Zstandard, to 23 bytes a message,
    because log times and stamps differ. The ratio and the message size leave a factor of ten. The
    ``free`` limits apply to every file and leave room for images and maps of zeros.
    """

    file_bytes: int = 8 * 2**30
    chunk_bytes: int = 128 * 2**20
    uncompressed_bytes: int = 16 * 2**30
    uncompressed_free_bytes: int = 512 * 2**20
    uncompressed_ratio: int = 1000
    records_count: int = 5_000_000
    messages_count: int = 20_000_000
    messages_free_count: int = 1_000_000
    packed_message_bytes: int = 2
    message_bytes: int = 16 * 2**20
    joints_count: int = 1024
    channels_count: int = 4096
    samples_count: int = 150_000_000
    undecodable_count: int = 100_000
    metadata_bytes: int = 16 * 2**20
    name_bytes: int = 1024

    def unpacked_bytes_of(self, file_bytes: int) -> int:
        """Return the largest decompressed size allowed for a file of this size, bytes."""
        allowed = self.uncompressed_free_bytes + self.uncompressed_ratio * file_bytes
        return min(self.uncompressed_bytes, allowed)

    def messages_of(self, file_bytes: int) -> int:
        """Return the largest number of messages allowed for a file of this size."""
        allowed = self.messages_free_count + file_bytes // self.packed_message_bytes
        return min(self.messages_count, allowed)


@dataclass(frozen=True, slots=True)
class CsvLimits:
    """Bounds on a recording in CSV: an hour of a seven-joint arm at 1 kHz fits.

    Numbers compress about 4 to 1 in gzip, columns that never change up to 50 to 1.
    """

    file_bytes: int = 4 * 2**30
    unpacked_free_bytes: int = 64 * 2**20
    unpacked_ratio: int = 100
    header_bytes: int = 2**20
    columns_count: int = 8192
    name_chars: int = 256
    cells_count: int = 150_000_000


@dataclass(frozen=True, slots=True)
class ObservationLimits:
    """Bounds on the observations of a calibration: a row for each pose, not for each sample."""

    file_bytes: int = 64 * 2**20
    rows_count: int = 20_000
    columns_count: int = 2048
    name_chars: int = 256


@dataclass(frozen=True, slots=True)
class TossLimits:
    """Bounds on tosses in a NumPy archive: ten thousand tosses of a second at 1 kHz fit."""

    file_bytes: int = 512 * 2**20
    unpacked_bytes: int = 2 * 2**30
    tosses_count: int = 20_000
    least_rows: int = 8


@dataclass(frozen=True, slots=True)
class StampLimits:
    """Bounds on stamped files, and on the stamp, which mostly consists of a signed release.

    Deflate compresses by 1,032 at most, so an HDF5 file of n bytes has at most ``hdf5_expansion`` n
    bytes of values, beside ``hdf5_least_bytes`` for fill values that are not stored.
    """

    stamp_bytes: int = 64 * 2**20
    files_count: int = 10_000
    onnx_bytes: int = 2 * 2**30
    hdf5_bytes: int = 64 * 2**30
    hdf5_expansion: int = 1_100
    hdf5_least_bytes: int = 2**20


@dataclass(frozen=True, slots=True)
class ParquetLimits:
    """Bounds on a data set in Parquet: a file's content, images included, and how many files."""

    uncompressed_bytes: int = 8 * 2**30
    files_count: int = 100_000


@dataclass(frozen=True, slots=True)
class ImageLimits:
    """Bounds on the images of a calibration: a camera of 100 megapixels fits."""

    file_bytes: int = 256 * 2**20
    pixels_count: int = 100_000_000
    files_count: int = 2000


@dataclass(frozen=True, slots=True)
class HashLimits:
    """Bound on a file that is only hashed."""

    file_bytes: int = 64 * 2**30


PATHS = PathLimits()
YAML = YamlLimits()
XML = XmlLimits()
TRACE = TraceLimits()
MCAP = McapLimits()
CSV = CsvLimits()
OBSERVATIONS = ObservationLimits()
PARQUET = ParquetLimits()
IMAGES = ImageLimits()
HASH = HashLimits()
STAMPS = StampLimits()
TOSSES = TossLimits()
