import io
import math
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsplat_tools.cloud import GaussianCloud
from gsplat_tools.errors import (
    CapabilityError,
    FormatError,
    GsplatError,
    GsplatWarning,
    LossyConversionWarning,
    NonFiniteWarning,
)
from gsplat_tools.formats import load
from gsplat_tools.formats.splat4d import Splat4dReadOptions, inspect, read
from tests.formats.splat4d import by_hand
from tests.formats.splat4d.by_hand import BAND_1, plain, record, with_band, with_deltas

FACTS = {
    "means": [1, 2, 3],
    "log_scales": [math.log(0.5), math.log(0.25), math.log(2)],
    "quats": [0, 1, 0, 0],
    "sh0": [0.5 / 0.28209479177387814, -0.5 / 0.28209479177387814, -0.3 / 0.28209479177387814],
    "velocities": [0.5, 0, -1],
}


def read_bytes(data: bytes, **options: object) -> GaussianCloud:
    return read(io.BytesIO(data), Splat4dReadOptions(**options))  # type: ignore[arg-type]


@pytest.mark.parametrize("data", [record(), plain().build()], ids=["version 1", "version 2"])
def test_read__gives_what_the_record_says(data: bytes) -> None:
    cloud = read_bytes(data)

    assert len(cloud) == 1
    for name, values in FACTS.items():
        assert getattr(cloud, name)[0] == pytest.approx(values, rel=1e-6), name
    assert cloud.opacity_logits[0] == pytest.approx(math.log(0.8 / 0.2), rel=1e-6)
    assert cloud.times is not None
    assert cloud.durations is not None
    assert (cloud.times[0], cloud.durations[0]) == (0.25, 0.5)
    assert (cloud.time_model, cloud.sh_degree) == ("window", 0)


def test_read__normalizes_rotations_and_takes_all_128_for_the_identity() -> None:
    cloud = read_bytes(record(quat=(0, 128, 128, 128)) + record(quat=(128, 128, 128, 128)) + record(quat=(160, 160, 96, 96)))

    assert cloud.quats.tolist() == [[1, 0, 0, 0], [1, 0, 0, 0], [0.5, 0.5, -0.5, -0.5]]


def test_read__takes_signaling_nans_without_a_warning_of_numpy() -> None:
    data = bytearray(record(velocity=(0, 0, 0), time=0.0, duration=1.0) * 2)
    data[32:36] = (0x7FA00000).to_bytes(4, "little")  # the first component of the first velocity

    cloud = read_bytes(bytes(data))

    assert cloud.velocities is not None
    assert np.isnan(cloud.velocities[0, 0])


def test_read__takes_the_ends_of_opacity_for_infinite_logits() -> None:
    cloud = read_bytes(record(rgba=(0, 0, 0, 0)) + record(rgba=(0, 0, 0, 255)))

    assert cloud.opacity_logits.tolist() == [-np.inf, np.inf]


def test_read__of_splats_that_stand_still_has_no_motion() -> None:
    still = record(velocity=(0, 0, 0), time=0, duration=1)

    assert not read_bytes(still * 3).has_motion
    assert read_bytes(still * 2 + record()).has_motion
    assert read_bytes(plain(still, time_model=2).build()).has_motion


def rows(outside: int, count: int, **odd: float) -> bytes:
    return record() * (count - outside) + record(**odd) * outside  # type: ignore[arg-type]


@pytest.mark.parametrize("odd", [{"time": 1.5}, {"time": -0.1}, {"duration": 2.0}, {"duration": -1.0}])
def test_read__takes_version_1_for_gaussian_above_one_percent(odd: dict[str, float]) -> None:
    with pytest.warns(GsplatWarning, match="taken as the gaussian"):
        assert _quiet(rows(3, 200, **odd)).time_model == "gaussian"
    with pytest.warns(LossyConversionWarning, match="window time model"):
        assert read_bytes(rows(2, 200, **odd)).time_model == "window"


def _quiet(data: bytes) -> GaussianCloud:
    """Read where a second warning, about what is repaired, may come."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the gaussian time model")
        return read_bytes(data)


def test_read__counts_times_and_durations_apart_and_takes_no_infinity_for_a_sign() -> None:
    with pytest.warns(LossyConversionWarning):
        assert read_bytes(rows(2, 200, time=1.5)[: 64 * 199] + record(duration=1.5)).time_model == "window"
    with pytest.warns(LossyConversionWarning):
        assert read_bytes(rows(10, 200, duration=math.inf)).time_model == "window"


def test_read__takes_the_time_model_that_is_asked_for() -> None:
    data = rows(100, 200, time=1.5)
    with pytest.warns(LossyConversionWarning, match="changed 100 times"):
        assert read_bytes(data, time_model="window").time_model == "window"
    assert read_bytes(record(), time_model="gaussian").time_model == "gaussian"


def test_read__clamps_windows_and_says_so_once() -> None:
    odd = plain(record(time=-0.2), record(duration=1.7), record(duration=-3), record())

    with pytest.warns(LossyConversionWarning) as caught:
        cloud = read_bytes(odd.build())

    assert len(caught) == 1
    assert "1 times (found -0.2 to -0.2) and 2 durations (found -3 to 1.7) of 4" in str(caught[0].message)
    assert cloud.times is not None
    assert cloud.durations is not None
    assert cloud.times.tolist() == [0, 0.25, 0.25, 0.25]
    assert cloud.durations.tolist() == [0.5, 1, 0, 0.5]


def test_read__repairs_gaussians_and_keeps_centers_outside() -> None:
    odd = plain(
        record(time=-2), record(time=math.nan), record(duration=0), record(duration=-1), record(duration=5), time_model=2
    )

    with pytest.warns(LossyConversionWarning, match=r"changed 1 times \(not finite\) and 2 durations"):
        cloud = read_bytes(odd.build())

    assert cloud.times is not None
    assert cloud.durations is not None
    assert cloud.times.tolist() == [-2, 0, 0.25, 0.25, 0.25]
    assert cloud.durations.tolist() == pytest.approx([0.5, 0.5, 1e-6, 1e-6, 5])


def test_load__drops_and_counts_what_no_splat_may_hold(tmp_path: Path) -> None:
    path = tmp_path / "odd.splat4d"
    odd = [record(mean=(math.nan, 0, 0)), record(scale=(-1, 1, 1)), record(velocity=(math.inf, 0, 0)), record(time=math.nan)]
    path.write_bytes(record() * 6 + b"".join(odd) + record(scale=(0, 1, 1)))

    with pytest.warns(NonFiniteWarning, match="dropped 4 of 11.*means-nan 1, log_scales-nan 1, velocities-inf 1, times-nan 1"):
        cloud = load(path)

    assert len(cloud) == 7
    assert isinstance(cloud, GaussianCloud)
    assert np.isneginf(cloud.log_scales[-1, 0])


@pytest.mark.parametrize("cutoff", [0.0, -1.0, 1.0, math.nan, math.inf])
def test_read__replaces_a_cutoff_that_means_nothing(cutoff: float) -> None:
    file = plain(time_model=2)
    file.sections[1] = by_hand.meta(cutoff=cutoff)
    with pytest.warns(GsplatWarning, match="temporalGaussianCutoff"):
        assert read_bytes(file.build()).temporal_cutoff == 0.01
    file.time_model = 1
    assert read_bytes(file.build()).temporal_cutoff == 0.01  # windows have none


def test_read__takes_the_cutoff_of_the_file() -> None:
    file = plain(time_model=2)
    file.sections[1] = by_hand.meta(cutoff=0.25)

    assert read_bytes(file.build()).temporal_cutoff == 0.25
    assert inspect(io.BytesIO(file.build())).encoding["temporal_cutoff"] == 0.25


def expected_band(labels: list[int]) -> list[list[list[float]]]:
    return [[BAND_1[label][3 * c : 3 * c + 3] for c in range(3)] for label in labels]


def test_read__takes_sh_from_codebooks_coefficients_outer_channels_inner() -> None:
    cloud = read_bytes(with_band([1, 0, 1]).build())

    assert cloud.sh_degree == 1
    assert cloud.shN.tolist() == expected_band([1, 0, 1])


def test_read__takes_three_bands_of_half_floats() -> None:
    sections = [by_hand.Section(b"RECS", record() * 2), by_hand.meta((1, 1, 1), (1, 1, 1), (2, 1, 1))]
    for band, (count, scalars) in enumerate(((1, 9), (1, 15), (2, 21)), start=1):
        numbers = [band + i / 4 for i in range(count * scalars)]
        sections.append(by_hand.Section(b"SHCT", struct.pack(f"<{len(numbers)}e", *numbers), band))
        sections.append(by_hand.Section(b"SHLB", struct.pack("<2H", 0, count - 1), band))

    cloud = read_bytes(by_hand.File(sections, 2, bands=3).build())

    assert cloud.shN.shape == (2, 15, 3)
    assert cloud.shN[0, 0].tolist() == [1, 1.25, 1.5]
    assert cloud.shN[0, 3].tolist() == [2, 2.25, 2.5]
    assert cloud.shN[0, 8].tolist() == [3, 3.25, 3.5]
    assert cloud.shN[1, 14].tolist() == [3 + i / 4 for i in (39, 40, 41)]


@pytest.mark.parametrize(("frame", "labels"), [(0, [1, 0, 1]), (1, [1, 0, 1]), (2, [0, 0, 1]), (3, [1, 1, 0]), (4, [1, 1, 1])])
def test_read__evaluates_labels_of_every_frame(frame: int, labels: list[int]) -> None:
    with pytest.warns(LossyConversionWarning, match=rf"SH of 3 of 3 splats changes over 5 frames: that of frame {frame}"):
        cloud = read_bytes(with_deltas().build(), frame=frame)

    assert cloud.shN.tolist() == expected_band(labels)


def test_read__has_no_frame_beyond_the_last() -> None:
    with pytest.raises(CapabilityError, match="5 frames, there is no frame 5"):
        read_bytes(with_deltas().build(), frame=5)
    with pytest.raises(CapabilityError, match="1 frames"):
        read_bytes(with_band().build(), frame=1)


def test_read__accepts_segments_that_share_labels_as_exporters_write_them() -> None:
    cloud = read_bytes(with_deltas(shares_labels=True).build(), frame=4)

    assert cloud.shN.tolist() == expected_band([1, 0, 1])


def test_read__skips_sections_of_unknown_kind() -> None:
    file = with_band()
    file.sections.insert(1, by_hand.Section(b"XTRA", b"anything"))

    assert read_bytes(file.build()).sh_degree == 1


LIES = {
    "version": lambda f: setattr(f, "version", 3),
    "headerSize": lambda f: setattr(f, "header_size", 60),
    "recordSize": lambda f: setattr(f, "record_size", 32),
    "shBands": lambda f: setattr(f, "bands", 4),
    "timeModel": lambda f: setattr(f, "time_model", 3),
    "splatCount": lambda f: setattr(f, "splats", 1 << 31),
    "sectionCount": lambda f: setattr(f, "section_count", 1 << 31),
    "sectionCount of the table": lambda f: setattr(f, "table_count", 2),
    "magic of the table": lambda f: setattr(f, "table_magic", b"TABL"),
    "version of the table": lambda f: setattr(f, "table_version", 2),
    "table in the header": lambda f: setattr(f, "table_offset", 8),
    "table behind the end": lambda f: setattr(f, "table_offset", 1 << 62),
    "table over records": lambda f: setattr(f, "table_offset", 64),
    "no records": lambda f: f.sections.pop(0),
    "records twice": lambda f: f.sections.insert(1, f.sections[0]),
    "no META": lambda f: f.sections.pop(1),
    "META of another length": lambda f: setattr(f.sections[1], "data", f.sections[1].data + bytes(4)),
    "META of another version": lambda f: f.sections.__setitem__(1, by_hand.meta((2, 2, 1), version=2)),
    "section behind the end": lambda f: setattr(f.sections[0], "offset", 1 << 40),
    "section longer than the file": lambda f: setattr(f.sections[2], "length", (1 << 64) - 1),
    "sections overlap": lambda f: setattr(f.sections[3], "offset", 64),
    "section over the header": lambda f: setattr(f.sections[3], "offset", 16),
    "same bytes for two kinds": lambda f: (setattr(f.sections[3], "offset", 64), setattr(f.sections[3], "length", 192)),
    "records too short": lambda f: setattr(f.sections[0], "length", 128),
    "codebook of nothing": lambda f: f.sections.__setitem__(1, by_hand.meta((0, 2, 1))),
    "codebook too large": lambda f: f.sections.__setitem__(1, by_hand.meta((1 << 31, 2, 1))),
    "codebook of another length": lambda f: f.sections.__setitem__(1, by_hand.meta((3, 2, 1))),
    "centroidsType": lambda f: f.sections.__setitem__(1, by_hand.meta((2, 3, 1))),
    "labelsEncoding": lambda f: f.sections.__setitem__(1, by_hand.meta((2, 2, 3))),
    "no codebook": lambda f: f.sections.pop(2),
    "no labels": lambda f: f.sections.pop(3),
    "labels of another length": lambda f: setattr(f.sections[3], "data", bytes(4)),
    "label beyond the codebook": lambda f: setattr(f.sections[3], "data", struct.pack("<3H", 0, 2, 0)),
    "deltas without frames": lambda f: f.sections.__setitem__(1, by_hand.meta((2, 2, 2))),
}


@pytest.mark.parametrize("name", LIES)
def test_read__refuses_files_that_lie(name: str) -> None:
    assert read_bytes(with_band().build()).sh_degree == 1
    file = with_band()
    LIES[name](file)

    with pytest.raises(FormatError) as caught:
        read_bytes(file.build())

    assert caught.value.field is not None
    assert caught.value.offset is not None or "one section" in str(caught.value)


DELTA_LIES = {
    "frameCount too large": lambda f: setattr(f, "frames", 6),
    "frameCount too small": lambda f: setattr(f, "frames", 4),
    "gap between segments": lambda f: (setattr(f.sections[5], "start", 4), setattr(f.sections[6], "start", 4)),
    "segments of different length": lambda f: setattr(f.sections[6], "frames", 1),
    "segment without changes": lambda f: f.sections.pop(6),
    "magic": lambda f: setattr(f.sections[6], "data", by_hand.delta(3, 2, 3, 2, [[]], magic=b"XXX4DLB1")),
    "start in the delta": lambda f: setattr(f.sections[6], "data", by_hand.delta(2, 2, 3, 2, [[]])),
    "splats in the delta": lambda f: setattr(f.sections[6], "data", by_hand.delta(3, 2, 4, 2, [[]])),
    "labels in the delta": lambda f: setattr(f.sections[6], "data", by_hand.delta(3, 2, 3, 9, [[]])),
    "block missing": lambda f: setattr(f.sections[6], "data", by_hand.delta(3, 2, 3, 2, [])),
    "trailing bytes": lambda f: setattr(f.sections[6], "data", by_hand.delta(3, 2, 3, 2, [[]], tail=b"\0")),
    "splat beyond": lambda f: setattr(f.sections[6], "data", by_hand.delta(3, 2, 3, 2, [[(3, 0)]])),
    "splats fall": lambda f: setattr(f.sections[6], "data", by_hand.delta(3, 2, 3, 2, [[(1, 0), (0, 0)]])),
    "splat twice": lambda f: setattr(f.sections[6], "data", by_hand.delta(3, 2, 3, 2, [[(1, 0), (1, 1)]])),
    "label beyond": lambda f: setattr(f.sections[6], "data", by_hand.delta(3, 2, 3, 2, [[(1, 2)]])),
    "too many updates": lambda f: setattr(f.sections[6], "data", by_hand.delta(3, 2, 3, 2, [[(0, 0)] * 4])),
}


@pytest.mark.parametrize("name", DELTA_LIES)
def test_read__refuses_deltas_that_lie_in_any_segment(name: str) -> None:
    file = with_deltas()
    DELTA_LIES[name](file)

    with pytest.raises(FormatError):
        read_bytes(file.build(), frame=0)


@pytest.mark.parametrize("data", [b"", bytes(63), bytes(65), record() + b"\0", b"SPL4DV03" + bytes(56), b"SPL4DV02"])
def test_read__refuses_what_is_of_neither_version(data: bytes) -> None:
    for function in (read, inspect):
        with pytest.raises(FormatError):
            function(io.BytesIO(data))


@settings(max_examples=400)
@given(st.data())
def test_read__of_a_damaged_file_raises_only_what_is_ours(data: st.DataObject) -> None:
    whole = bytearray(data.draw(st.sampled_from([with_band().build(), with_deltas().build()])))
    for _ in range(data.draw(st.integers(1, 4))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    damaged = bytes(whole[: data.draw(st.integers(0, len(whole)))]) if data.draw(st.booleans()) else bytes(whole)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GsplatWarning)
        for function in (read, inspect):
            try:
                function(io.BytesIO(damaged))
            except GsplatError:
                continue


def test_inspect__gives_bounds_grown_by_motion() -> None:
    data = record(mean=(0, 0, 0), velocity=(3, 0, 4), duration=0.5) + record(mean=(1, 1, 1), velocity=(0, 0, 0), duration=1)
    one, two = inspect(io.BytesIO(data)), inspect(io.BytesIO(plain(data[:64], data[64:]).build()))

    assert (one.version, two.version) == ("1", "2")
    for info in (one, two):
        assert info.splats == 2
        assert info.bounds == ([0, 0, 0], [1, 1, 1])
        assert info.motion_bounds == ([-5, -5, -5], [6, 6, 6])  # speed 5 for a duration of 1


def test_inspect__gives_gaussian_bounds_to_the_cutoff() -> None:
    file = plain(record(mean=(0, 0, 0), velocity=(1, 0, 0), duration=0.5), time_model=2)
    file.sections[1] = by_hand.meta(cutoff=math.exp(-2))

    box = inspect(io.BytesIO(file.build())).motion_bounds

    assert box is not None
    assert box[1] == pytest.approx([1, 1, 1], rel=1e-6)  # two sigma of 0.5 at speed 1


def test_inspect__tells_how_labels_are_stored() -> None:
    info = inspect(io.BytesIO(with_deltas().build()))

    assert info.sh_degree == 1
    assert info.encoding["palettes"] == {"sh1": {"entries": 2, "centroids": "f32", "labels": "delta-v1", "segments": 2}}
    assert info.encoding["label_frames"] == 5
