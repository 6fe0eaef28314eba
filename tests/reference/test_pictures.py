import numpy as np
import pytest

from gsplat_tools.reference.pictures import contact_sheet, difference_picture, to_uint8


def test_to_uint8__clamps_and_rounds() -> None:
    image = np.array([[[-1.0, 0.0, 0.49 / 255], [0.51 / 255, 1.0, 2.0], [np.nan, np.inf, 0.5]]], np.float32)

    assert to_uint8(image).tolist() == [[[0, 0, 0], [1, 255, 255], [0, 255, 128]]]
    assert to_uint8(to_uint8(image)).max() == 255


def test_contact_sheet__lays_pictures_out_in_rows() -> None:
    pictures = [np.full((4, 6, 3), value) for value in (0.2, 0.4, 0.6)]

    sheet = contact_sheet(pictures, columns=2)

    assert sheet.shape == (4 + 4 + 4, 6 + 4 + 6, 3)
    assert sheet[0, 0, 0] == 51
    assert sheet[0, 10, 0] == 102
    assert sheet[8, 0, 0] == 153
    assert sheet[5, 3, 0] == sheet[9, 12, 0] == 32  # between and beyond the pictures
    assert contact_sheet(pictures[:1]).shape == (4, 6, 3)
    assert contact_sheet([np.zeros((9, 16, 3))] * 8).shape[1] > contact_sheet([np.zeros((9, 16, 3))] * 8).shape[0]
    with pytest.raises(ValueError, match="at least one picture"):
        contact_sheet([])
    with pytest.raises(ValueError, match="columns"):
        contact_sheet(pictures, columns=0)


def test_difference_picture__amplifies() -> None:
    a, b = np.full((2, 2, 3), 0.5), np.full((2, 2, 3), 0.5 + 1 / 255)

    assert np.all(difference_picture(a, b) == 10)
    assert np.all(difference_picture(b, a, gain=300) == 255)
    with pytest.raises(ValueError, match="one shape"):
        difference_picture(a, b[:1])
