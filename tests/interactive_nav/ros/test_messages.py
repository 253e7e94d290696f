"""Messages by value: their fields, and what is read back."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from interactive_nav.ros import messages
from interactive_nav.sensing.base import seen_through
from interactive_nav_common.errors import UserError
from scenes_mjcf.look import Lens

HEAD = messages.header(0.3, "base_link")


def test_an_image_comes_back_and_its_bytes_run_left_to_right_top_to_bottom():
    rgb = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)
    image = messages.image_message(rgb, HEAD)
    assert (image.height, image.width, image.step, image.encoding) == (2, 3, 9, "rgb8")
    assert bytes(image.data[:6]) == bytes([0, 1, 2, 3, 4, 5]) and len(image.data) == 18
    assert (messages.image_array(image) == rgb).all()
    assert (image.header.frame_id, messages.seconds(image.header.stamp)) == ("base_link", pytest.approx(1.3))


def test_other_encodings_and_padded_rows_are_read():
    # One row of two pixels, blue first, with an alpha byte, and two bytes of padding.
    data = bytes([1, 2, 3, 255, 4, 5, 6, 255, 0, 0])
    message = messages.Image(height=1, width=2, step=10, encoding="bgra8", data=data)
    assert messages.image_array(message).tolist() == [[[3, 2, 1], [6, 5, 4]]]


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"encoding": "mono8"}, "image encoding is 'mono8', expected one of rgb8, bgr8, rgba8, bgra8"),
        ({"data": b"abc"}, "image of 2 x 1 (rgb8) has 3 bytes in rows of 6, expected 6 in rows of 6"),
        ({"step": 5, "data": b"abcde"}, "has 5 bytes in rows of 5"),
    ],
)
def test_images_that_cannot_be_read_are_told(changed, told):
    message = messages.Image(**{"height": 1, "width": 2, "step": 6, "encoding": "rgb8", "data": bytes(6), **changed})
    with pytest.raises(messages.MessageError) as error:
        messages.image_array(message)
    assert told in str(error.value)


def test_a_camera_of_90_degrees_has_a_focal_length_of_half_its_height():
    info = messages.info_message(Lens(640, 480, 90.0), HEAD)
    assert info.k == pytest.approx([240, 0, 319.5, 0, 240, 239.5, 0, 0, 1])
    assert info.p == pytest.approx([240, 0, 319.5, 0, 0, 240, 239.5, 0, 0, 0, 1, 0])
    lens = messages.info_lens(info)
    assert (lens.width, lens.height) == (640, 480) and lens.fov_deg == pytest.approx(90.0)


@pytest.mark.parametrize(
    ("name", "at", "value", "told"),
    [
        ("k", 4, 0.0, "no focal length"),
        ("k", 0, 300.0, "focal lengths 300.0 and 240.0, expected square pixels"),
        ("d", 0, -0.2, "subscribe to a rectified image"),
    ],
)
def test_cameras_that_are_no_pinholes_are_refused(name, at, value, told):
    info = messages.info_message(Lens(640, 480, 90.0), HEAD)
    getattr(info, name)[at] = value
    with pytest.raises(messages.MessageError, match=told):
        messages.info_lens(info)


def test_a_narrower_lens_sees_the_middle():
    # 90 degrees over 8 rows: a pixel is 0.25 high at depth 1. Half of that tangent is 4 rows, and 4 x 4 of them.
    rgb = np.zeros((8, 8, 3), np.uint8)
    rgb[2:6, 2:4], rgb[2:6, 4:6] = 200, 100
    narrow = Lens(2, 2, math.degrees(2 * math.atan(0.5)))
    assert seen_through(rgb, 90.0, narrow)[..., 0].tolist() == [[200, 100], [200, 100]]
    # The same lens leaves it as it is; coarser pixels are means.
    assert (seen_through(rgb, 90.0, Lens(8, 8, 90.0)) == rgb).all()
    assert seen_through(rgb, 90.0, Lens(2, 2, 90.0))[..., 0].tolist() == [[50, 25], [50, 25]]


def test_a_wider_lens_than_the_cameras_is_refused():
    with pytest.raises(UserError, match="spans 60.0 degrees in height, the networks learned from 64 x 48"):
        seen_through(np.zeros((48, 64, 3), np.uint8), 60.0, Lens(64, 48, 90.0))
    with pytest.raises(UserError, match="use a wider lens"):
        seen_through(np.zeros((48, 48, 3), np.uint8), 90.0, Lens(64, 48, 90.0))


def test_a_scan_begins_at_the_right_and_infinity_means_nothing_met():
    # Four beams over 240 degrees: -120, -60, 0 and 60; the third meets a wall 2.8 m ahead.
    scan = messages.scan_message(np.array([1.0, 0.5, 0.5, 0.25], np.float32), 240.0, 0.05, 5.6, 0.1, HEAD)
    assert np.degrees([scan.angle_min, scan.angle_max, scan.angle_increment]) == pytest.approx([-120, 60, 60])
    assert list(scan.ranges) == pytest.approx([math.inf, 2.8, 2.8, 1.4])


@given(st.floats(-math.pi, math.pi))
def test_headings_survive_the_quaternion(yaw):
    quat = messages.yaw_quat(yaw)
    assert math.hypot(quat.z, quat.w) == pytest.approx(1)
    assert math.remainder(messages.quat_yaw(quat) - yaw, math.tau) == pytest.approx(0, abs=1e-9)


def test_yaw_of_a_tilted_robot_and_of_a_quaternion_that_is_not_of_length_one():
    # Yaw 90 degrees after a roll of 30: q = qz(90) qx(30).
    s, c = math.sin(math.radians(15)), math.cos(math.radians(15))
    half = math.sqrt(0.5)
    quat = messages.Quaternion(x=2 * half * s, y=2 * half * s, z=2 * half * c, w=2 * half * c)
    assert messages.quat_yaw(quat) == pytest.approx(math.pi / 2)
    with pytest.raises(messages.MessageError, match="has no heading"):
        messages.quat_yaw(messages.Quaternion(x=0.0, y=0.0, z=0.0, w=0.0))


def test_odometry_has_its_pose_in_the_start_frame_and_its_speed_in_the_robots():
    moving = np.array([0.5, 0.1, 0.0]), np.array([0, 0, -0.2])
    odometry = messages.odometry_message(np.array([1.0, 2.0, math.pi]), *moving, HEAD)
    pose, twist = odometry.pose.pose, odometry.twist.twist
    assert (pose.position.x, pose.position.y, pose.position.z) == (1.0, 2.0, 0.0)
    assert messages.quat_yaw(pose.orientation) == pytest.approx(math.pi)
    assert (twist.linear.x, twist.linear.y, twist.angular.z, odometry.child_frame_id) == (0.5, 0.1, -0.2, "base_link")


def test_the_imu_marks_accelerations_as_unknown():
    imu = messages.imu_message(0.3, np.array([0.0, 0.0, 0.7]), HEAD)
    assert messages.quat_yaw(imu.orientation) == pytest.approx(0.3)
    assert imu.angular_velocity.z == 0.7 and imu.linear_acceleration_covariance[0] == -1


def test_velocity_commands_come_back_and_must_be_finite():
    message = messages.twist_message(0.4, -0.25)
    assert messages.twist_command(message) == (0.4, -0.25)
    message.angular.z = math.nan
    for refused in (lambda: messages.twist_command(message), lambda: messages.twist_message(math.nan, 0.0)):
        with pytest.raises(messages.MessageError, match="expected finite numbers"):
            refused()


def test_the_optical_frame_looks_along_x_with_its_x_to_the_right():
    x, y, z, w = (getattr(messages.OPTICAL_QUAT, name) for name in "xyzw")
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    # Columns: its x, y and z axes in the frame that looks along x, y left, z up.
    assert rotation.T.tolist() == [[0, -1, 0], [0, 0, -1], [1, 0, 0]]


def test_times_are_whole_microseconds():
    stamps = [messages.stamp(time_s) for time_s in (0.3, 0.1 + 0.2, 1.9999999)]
    assert [(s.sec, s.nanosec) for s in stamps] == [(1, 300_000_000), (1, 300_000_000), (3, 0)]


def test_sensors_data_may_be_lost_and_commands_may_not():
    best, sure = messages.ReliabilityPolicy.BEST_EFFORT, messages.ReliabilityPolicy.RELIABLE
    for topic in (messages.IMAGE, messages.INFO, messages.SCAN, messages.HEADING, "/camera/left/depth/image_raw"):
        assert messages.qos(topic).reliability == messages.qos(topic, reading=True).reliability == best
        assert messages.qos(topic, lossless=True).reliability == sure
    assert messages.qos(messages.ODOMETRY).reliability == messages.qos(messages.COMMAND).reliability == sure
    assert messages.qos(messages.COMMAND, reading=True).reliability == sure
    assert messages.qos(messages.ODOMETRY, reading=True).reliability == best
