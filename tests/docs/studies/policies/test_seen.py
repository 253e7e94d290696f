import numpy as np

from docs.studies.policies.seen import WIDTH_PX, picture, strip


def test_pictures_of_every_dtype_span_black_to_white():
    grey = np.array([[[0.0], [0.5], [1.0]]], np.float32)
    assert picture(grey).tolist() == [[[0] * 3, [128] * 3, [255] * 3]]
    assert picture(np.array([[[7, 8, 9]]], np.uint8)).tolist() == [[[7, 8, 9]]]
    normals = np.array([[[-1.0, 0.0, 1.0]]], np.float32)
    assert picture(normals).tolist() == [[[0, 128, 255]]]


def test_strip_has_a_column_for_each_frame_and_a_line_for_each_image():
    red, blue = np.full((2, 2, 3), (255, 0, 0), np.uint8), np.full((2, 2, 3), (0, 0, 255), np.uint8)
    frames = [{"pixels/b": blue, "pixels/a": red}, {"pixels/b": red, "pixels/a": blue}]
    drawn = np.asarray(strip(frames, ["0.0 s\n2.0 m to go", "1.0 s\n1.0 m to go"]))
    # Two columns of 378 px with 4 px between, two lines of images and one of 34 px for the labels.
    assert drawn.shape == (2 * 382 + 34, WIDTH_PX, 3)
    corners = [drawn[y, x].tolist() for y in (0, 382) for x in (0, 382)]
    assert corners == [[255, 0, 0], [0, 0, 255], [0, 0, 255], [255, 0, 0]]
    assert (drawn[:764, 378:382] == 255).all()
    assert drawn[764:, :378].min() < 128 and drawn[764:, 382:].min() < 128
