import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcloseup.geometry.rotations import euler_to_matrix, matrix_to_euler, quaternion_to_matrix


def about(axis, angle):
    """Rotation matrix about one axis, from OpenCV."""
    return cv2.Rodrigues(np.eye(3)[axis] * angle)[0]


def random_angles(key, shape):
    return jax.random.uniform(key, (*shape, 3), minval=-3.1, maxval=3.1)


@pytest.mark.parametrize("jit", [False, True])
@pytest.mark.parametrize("shape", [(), (4,), (2, 3)])
def test_euler_angles_compose_as_rz_ry_rx(key, shape, jit):
    angles = random_angles(key, shape)
    convert = jax.jit(euler_to_matrix) if jit else euler_to_matrix
    matrices = np.asarray(convert(angles)).reshape(-1, 3, 3)
    for matrix, (x, y, z) in zip(matrices, np.asarray(angles).reshape(-1, 3), strict=True):
        np.testing.assert_allclose(matrix, about(2, z) @ about(1, y) @ about(0, x), atol=1e-6)


def test_matrices_are_orthonormal_with_determinant_one(key):
    key_angles, key_quaternions = jax.random.split(key)
    quaternions = jax.random.normal(key_quaternions, (50, 4)) * 3
    for matrices in (
        euler_to_matrix(random_angles(key_angles, (50,))),
        quaternion_to_matrix(quaternions),
    ):
        identity = jnp.broadcast_to(jnp.eye(3), matrices.shape)
        np.testing.assert_allclose(matrices @ matrices.mT, identity, atol=1e-5)
        np.testing.assert_allclose(jnp.linalg.det(matrices), 1, atol=1e-5)


def test_euler_angles_are_recovered(key):
    angles = random_angles(key, (200,)) * jnp.array([[1, 0.49, 1]])
    np.testing.assert_allclose(matrix_to_euler(euler_to_matrix(angles)), angles, atol=2e-5)


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("distance", [0, 1e-7, 1e-5, 1e-3])
def test_gimbal_lock_reproduces_the_matrix_with_finite_gradients(key, sign, distance):
    angles = random_angles(key, (100,)).at[:, 1].set(sign * (jnp.pi / 2 - distance))
    matrices = euler_to_matrix(angles)
    np.testing.assert_allclose(euler_to_matrix(matrix_to_euler(matrices)), matrices, atol=1e-6)
    exact = jnp.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    np.testing.assert_allclose(euler_to_matrix(matrix_to_euler(exact)), exact, atol=1e-6)
    jacobian = jax.vmap(jax.jacrev(matrix_to_euler))(jnp.concatenate([matrices, exact[None]]))
    assert jnp.all(jnp.isfinite(jacobian))


def test_quaternions_match_rodrigues_at_any_norm(key):
    key_axis, key_angle = jax.random.split(key)
    axes = jax.random.normal(key_axis, (20, 3))
    axes /= jnp.linalg.norm(axes, axis=-1, keepdims=True)
    angles = jax.random.uniform(key_angle, (20, 1), maxval=3)
    quaternions = 5 * jnp.concatenate([jnp.cos(angles / 2), jnp.sin(angles / 2) * axes], axis=-1)
    for matrix, vector in zip(
        quaternion_to_matrix(quaternions), np.asarray(axes * angles, np.float64), strict=True
    ):
        np.testing.assert_allclose(matrix, cv2.Rodrigues(vector)[0], atol=1e-5)


def test_the_zero_quaternion_is_the_identity_with_finite_gradients():
    zero = jnp.zeros(4)
    np.testing.assert_array_equal(quaternion_to_matrix(zero), jnp.eye(3))
    assert jnp.all(jnp.isfinite(jax.jacrev(quaternion_to_matrix)(zero)))
