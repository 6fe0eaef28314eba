import numpy as np
import pytest

from gsplat_tools.formats.knobs import Knob
from gsplat_tools.formats.preparing import SaveChoices
from gsplat_tools.formats.registry import FORMATS
from gsplat_tools.formats.saving import split_options
from gsplat_tools.tuning.streams import StreamModel


@pytest.mark.parametrize("record", [each for each in FORMATS.values() if each.write is not None], ids=lambda record: record.id)
def test_knobs__name_options_of_the_format_and_values_that_it_takes(record) -> None:
    for name, knob in record.knobs.items():
        assert len(set(knob.values)) == len(knob.values)
        for value in knob.values:
            choices, own = split_options(record, "balanced", {name: value})
            assert getattr(choices if name in SaveChoices.__dataclass_fields__ else own, name) == value


def test_options__leave_out_what_says_nothing_beside_the_others() -> None:
    knobs = {
        "sh_degree": Knob(values=(0, 1), stream="sh"),
        "size": Knob(values=(8, 16), stream="sh", graded=True, needs={"sh_degree": (1,)}),
    }

    options = StreamModel("sh", knobs, {}).options

    assert options == [(("sh_degree", 0),), (("sh_degree", 1), ("size", 8)), (("sh_degree", 1), ("size", 16))]


def measured(values: dict[int, tuple[float, float]]) -> StreamModel:
    """A stream of one graded knob whose options were measured at some values: (bytes, error)."""
    stream = StreamModel("colors", {"n": Knob(values=(1, 2, 4, 8, 16), stream="colors", graded=True)}, {})
    for value, (size, error) in values.items():
        at = stream.options.index((("n", value),))
        stream.bytes[at], stream.errors[at] = size, np.array([error])
    return stream


def test_predict__runs_straight_in_bytes_and_logarithms_of_errors_and_beyond() -> None:
    sizes, errors = measured({2: (100.0, 1e-3), 8: (200.0, 1e-5)}).predict()

    assert sizes.tolist() == pytest.approx([50, 100, 150, 200, 250])
    assert errors[:, 0].tolist() == pytest.approx([1e-2, 1e-3, 1e-4, 1e-5, 1e-6])


def test_predict__knows_nothing_of_what_was_never_measured_and_nothing_is_impossible_only_once() -> None:
    stream = measured({2: (100.0, 1e-3), 8: (200.0, 1e-5)})
    stream.is_impossible[4] = True

    assert stream.predict()[0][4] == np.inf
    assert np.isinf(measured({}).predict()[0]).all()
