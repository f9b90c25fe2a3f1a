import numpy as np

from isaacgymenvs_lite.motion import kinematics

# Exact formulas in float64: only rounding remains.
ATOL = 1e-12


def test_forward_kinematics_of_a_chain(about) -> None:
    # Root turned by 90 deg about z, the middle link by another 90 deg.
    rotation = np.stack(
        (about("z", [np.pi / 2]), about("z", [np.pi / 2]), about("z", [0.0])), axis=1
    )
    offsets = np.array([[9.0, 9.0, 9.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    positions, turns = kinematics.forward_kinematics(
        (-1, 0, 1), offsets, rotation, np.array([[5.0, 0.0, 1.0]])
    )
    expected = [[5.0, 0.0, 1.0], [5.0, 1.0, 1.0], [4.0, 1.0, 1.0]]
    np.testing.assert_allclose(positions[0], expected, atol=ATOL)
    np.testing.assert_allclose(turns[0, 2], about("z", [np.pi])[0], atol=ATOL)


def test_local_rotations_undo_forward_kinematics(tiny_clip) -> None:
    _, turns = tiny_clip.global_poses()
    local = kinematics.local_rotations(tiny_clip.parent_indices, turns)
    np.testing.assert_allclose(local, tiny_clip.local_rotation, atol=ATOL)


def test_angular_velocity_is_in_the_world_frame(about) -> None:
    # The body's own z axis lies along world -y after the first turn about x.
    tilt = about("x", [np.pi / 2])[0]
    rotation = np.stack([_product(tilt, spin) for spin in about("z", 0.05 * np.arange(40))])
    velocity = kinematics.angular_velocities(rotation[:, None], fps=30.0)
    # 0.05 rad * 30 = 1.5 rad/s; the filter mixes the last 8 frames with the last one, at rest.
    np.testing.assert_allclose(velocity[:31, 0], np.tile([0.0, -1.5, 0.0], (31, 1)), atol=1e-10)


def test_velocities_are_smoothed_by_a_gaussian_of_two_frames(about) -> None:
    # One turn of 0.1 rad between frames 20 and 21. The weight of the middle of a Gaussian with
    # sigma 2 and reach 8: 1 / (1 + 2 (0.8825 + 0.6065 + 0.3247 + 0.1353 + ...)) = 0.19948.
    rotation = about("z", [0.0] * 21 + [0.1] * 19)[:, None]
    velocity = kinematics.angular_velocities(rotation, fps=1.0)
    np.testing.assert_allclose(velocity[20, 0, 2], 0.1 * 0.19948, rtol=1e-4)
    np.testing.assert_allclose(velocity[28, 0, 2] / velocity[20, 0, 2], np.exp(-8.0), rtol=1e-9)
    assert velocity[29, 0, 2] == 0.0


def test_joint_velocity_is_in_the_child_frame_and_ends_with_a_copy(about) -> None:
    tilt = about("x", [np.pi / 2])[0]
    rotation = np.stack([_product(tilt, spin) for spin in about("z", [0.0, 0.1, 0.3])])
    velocity = kinematics.joint_velocities(rotation[:, None], fps=10.0)
    np.testing.assert_allclose(velocity[:, 0], [[0, 0, 1], [0, 0, 2], [0, 0, 2]], atol=1e-9)


def test_joint_velocity_of_float32_data_has_the_rounding_of_the_original(about) -> None:
    # Half of 1e-4 rad has the cosine 1 - 1.25e-9, which is 1 in float32.
    rotation = about("y", [0.0, 1e-4])[:, None]
    exact = kinematics.joint_velocities(rotation, fps=10.0)
    rounded = kinematics.joint_velocities(rotation.astype(np.float32), fps=10.0)
    np.testing.assert_allclose(exact[0, 0], [0.0, 1e-3, 0.0], rtol=1e-6)
    np.testing.assert_array_equal(rounded, 0.0)


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return a * b (xyzw), written out independently of the code under test."""
    vector = a[3] * b[:3] + b[3] * a[:3] + np.cross(a[:3], b[:3])
    return np.append(vector, a[3] * b[3] - a[:3] @ b[:3])
