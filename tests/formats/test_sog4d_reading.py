"""What a bundle means, worked out by hand from its bytes."""

from __future__ import annotations

import io
import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsplat_tools.errors import CapabilityError, CloudError, FormatError, GsplatWarning
from gsplat_tools.formats import load
from gsplat_tools.formats.sog4d import Sog4dReadOptions, inspect, planes, read
from gsplat_tools.sequence import GaussianSequence
from tests.sog4d_bundles import (
    BROKEN,
    LABELS,
    SCALES,
    SH0,
    SPLATS,
    archive,
    centroids,
    image,
    valid_bundle,
    valid_files,
    valid_meta,
)


def opened(data: bytes, **options: Any) -> GaussianSequence:
    return read(io.BytesIO(data), Sog4dReadOptions(**options))


def version_2_bundle() -> bytes:
    """The valid bundle with palettes by band, full labels, degree 2, uniform times."""
    meta, files = valid_meta(), valid_files()
    meta |= {"version": 2, "timeMapping": {"type": "uniform"}}
    sh = {name: value for name, value in meta["streams"]["sh"].items() if not name.startswith("shN")} | {"bands": 2}
    for band, coefficients in ((1, 3), (2, 5)):
        values = (np.arange(2 * coefficients * 3) + 100 * band) / 64
        files[f"c{band}.bin"] = values.astype("<f2").tobytes()
        sh[f"sh{band}"] = {
            "count": 2,
            "centroidsType": "f16",
            "centroidsPath": f"c{band}.bin",
            "labelsPath": f"frames/{{frame}}/l{band}.webp",
        }
        for frame in range(3):
            files[f"frames/{frame:05d}/l{band}.webp"] = image([((i + frame + band) % 2, 0) for i in range(SPLATS)])
    meta["streams"]["sh"] = sh
    return archive(meta, files)


def test_means__are_sixteen_bits_in_the_range_of_the_frame() -> None:
    frame = opened(valid_bundle()).frame(1)

    q = [(51 * i << 8) | i for i in range(SPLATS)]
    assert frame.means[:, 0].tolist() == pytest.approx([1 + code / 65535 for code in q], abs=2e-7)
    assert frame.means[:, 1].tolist() == pytest.approx([-1 + 2 * ((10 << 8) | 7) / 65535] * SPLATS, abs=2e-7)
    assert frame.means[:, 2].tolist() == [0.0] * SPLATS


def test_scales__are_logs_of_the_codebook() -> None:
    frame = opened(valid_bundle()).frame(1)

    expected = [[math.log(s) for s in SCALES[(i + 1) % 3]] for i in range(SPLATS)]
    assert np.allclose(frame.log_scales, expected, atol=1e-6)


def test_scale_of_zero__is_a_flat_axis() -> None:
    meta: Any = valid_meta()
    meta["streams"]["scale"]["codebook"][0]["z"] = 0

    assert opened(archive(meta, valid_files())).frame(0).log_scales[0, 2] == -np.inf


def test_rotation__is_normalized_with_w_positive() -> None:
    frame = opened(valid_bundle()).frame(1)

    stored = np.array([(127, 0, i, -9) for i in range(SPLATS)], float)
    assert np.allclose(frame.quats, stored / np.linalg.norm(stored, axis=1, keepdims=True), atol=1e-6)


def test_colors__are_codebook_entries_and_alpha_is_opacity() -> None:
    frame = opened(valid_bundle()).frame(2)

    assert frame.sh0.tolist() == [[SH0[i], SH0[102], SH0[255 - i]] for i in range(SPLATS)]
    assert frame.opacity_logits[0] == -np.inf
    assert 1 / (1 + np.exp(-frame.opacity_logits[1:4].astype(float))) == pytest.approx([0.2, 0.4, 0.6], abs=1e-6)


def test_labels__follow_the_changes_in_any_order_of_frames() -> None:
    sequence = opened(valid_bundle())

    for frame in (1, 0, 2, 1, 2, 0):
        assert np.array_equal(sequence.frame(frame).shN, centroids()[LABELS[frame]]), frame


def test_version_2__joins_the_bands() -> None:
    sequence = opened(version_2_bundle())

    assert sequence.sh_degree == 2
    assert sequence.is_uniform
    rest = sequence.frame(1).shN
    for i in range(SPLATS):
        entries = [((i + 1 + band) % 2, coefficients, 100 * band) for band, coefficients in ((1, 3), (2, 5))]
        expected = [(label * n * 3 + k + base) / 64 for label, n, base in entries for k in range(n * 3)]
        assert rest[i].ravel().tolist() == expected


def test_channel_major__undoes_the_order_of_the_existing_tool() -> None:
    scrambled = opened(valid_bundle(), shn_order="channel-major").frame(0).shN

    # Its entries hold R of all coefficients, then G, then B.
    flat = centroids().reshape(3, 9)[LABELS[0]]
    for coefficient in range(3):
        for channel in range(3):
            assert np.array_equal(scrambled[:, coefficient, channel], flat[:, channel * 3 + coefficient])


def test_foreign_bundle__warns_that_its_sh_may_be_scrambled() -> None:
    with pytest.warns(GsplatWarning, match="channel-major") as caught:
        opened(BROKEN["foreign-sh"]())

    assert [warning.message.code for warning in caught] == ["foreign-sh"]  # type: ignore[union-attr]


def test_legacy_vectors__are_read_with_a_warning() -> None:
    with pytest.warns(GsplatWarning, match="normalize"):
        sequence = opened(BROKEN["vector-list"]())

    assert np.array_equal(sequence.frame(1).means, opened(valid_bundle()).frame(1).means)


def test_second_meta_json__counts() -> None:
    changed: Any = valid_meta()
    changed["streams"]["position"]["rangeMax"][0]["x"] = 11
    target = io.BytesIO(archive(valid_meta(), valid_files()))
    import zipfile

    with pytest.warns(UserWarning, match="Duplicate name"), zipfile.ZipFile(target, "a") as bundle:  # zipfile's own
        bundle.writestr("meta.json", json.dumps(changed))

    with pytest.warns(GsplatWarning, match="last"):
        sequence = opened(target.getvalue())
    assert sequence.bounds()[1][0] == 11  # type: ignore[index]


def test_times_and_bounds__come_from_the_header() -> None:
    sequence = opened(valid_bundle())

    assert sequence.frame_times.tolist() == [0.0, 0.25, 1.0]
    low, high = sequence.bounds()  # type: ignore[misc]
    assert (low.tolist(), high.tolist()) == ([0, -1, 0], [3, 1, 0])


def test_inspect__tells_the_header() -> None:
    info = inspect(io.BytesIO(valid_bundle()))

    assert (info.version, info.splats, info.sh_degree, info.frames) == ("1", SPLATS, 1, 3)
    assert info.bounds == ([0, -1, 0], [3, 1, 0])
    assert info.encoding["palettes"] == {"shN": {"entries": 3, "centroids": "f32", "labels": "delta-v1", "segments": 2}}


def test_inspect__loads_no_compiler(tmp_path: Path) -> None:
    path = tmp_path / "a.sog4d"
    path.write_bytes(valid_bundle())
    code = (
        "import sys; from gsplat_tools.formats.loading import inspect_file; "
        f"inspect_file({str(path)!r}); assert 'numba' not in sys.modules"
    )

    subprocess.run([sys.executable, "-c", code], check=True)


def test_planes__are_the_raw_bytes(tmp_path: Path) -> None:
    path = tmp_path / "a.sog4d"
    path.write_bytes(valid_bundle())

    images = planes(path, 1)

    assert set(images) == {"position_hi", "position_lo", "scale_indices", "rotation", "sh0", "shN_labels"}
    assert images["sh0"].shape == (2, 3, 4)
    assert images["sh0"].reshape(-1, 4)[1].tolist() == [1, 101, 254, 51]
    assert images["sh0"].reshape(-1, 4)[0].tolist() == [0, 101, 255, 0]  # color under alpha 0 survives
    assert images["shN_labels"].reshape(-1, 4)[:SPLATS, 0].tolist() == LABELS[1]
    with pytest.raises(CloudError, match=r"0\.\.2"):
        planes(path, 3)


def test_planes__of_a_broken_bundle_name_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.sog4d"
    path.write_bytes(valid_bundle()[:-30])

    with pytest.raises(FormatError, match=r"a\.sog4d"):
        planes(path, 0)


def test_load__keeps_the_file_open_for_later_frames(tmp_path: Path) -> None:
    path = tmp_path / "a.sog4d"
    path.write_bytes(valid_bundle())

    sequence = load(path)

    assert isinstance(sequence, GaussianSequence)
    assert len(sequence.frame(2)) == SPLATS


def test_read_options__refuse_unknown_words() -> None:
    with pytest.raises(CapabilityError, match="interleaved, channel-major"):
        Sog4dReadOptions(shn_order="red-first")  # type: ignore[arg-type]
