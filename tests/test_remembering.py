import numpy as np

from gsplat_tools.remembering import remembered, remembering

calls: list[float] = []


@remembered
def doubled(values: np.ndarray, factor: float = 2.0) -> np.ndarray:
    calls.append(factor)
    return values * factor


def count_of(*arguments: object, **named: object) -> int:
    before = len(calls)
    doubled(*arguments, **named)
    return len(calls) - before


def test_remembered__is_called_once_for_equal_arrays_inside_the_block_and_every_time_outside() -> None:
    values = np.arange(4.0)

    assert count_of(values) == count_of(values) == 1
    with remembering():
        assert [count_of(values), count_of(values.copy()), count_of(values + 1), count_of(values, factor=3.0)] == [1, 0, 1, 1]
        with remembering():
            assert count_of(values) == 0
        assert count_of(values.astype(np.float32)) == 1
    assert count_of(values) == 1


def test_remembered__hands_out_results_that_nobody_can_change() -> None:
    with remembering():
        assert not doubled(np.arange(3.0)).flags.writeable
    assert doubled(np.arange(3.0)).flags.writeable
