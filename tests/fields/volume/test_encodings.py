import jax
import numpy as np
import pytest

from jaxcloseup.fields.volume.encodings import positional_encoding


@pytest.mark.parametrize("shape", [(3, 7), (2, 1)])
def test_encoding_matches_numpy(key, shape):
    x = jax.random.uniform(key, shape, minval=-1, maxval=1)
    wide = np.asarray(x, np.float64)
    parts = [wide]
    for k in range(10):
        parts += [np.sin(2**k * wide), np.cos(2**k * wide)]
    ours = jax.jit(positional_encoding, static_argnums=1)(x, 10)
    # x is rounded to half of 2^-24, and the highest octave multiplies that by 2^9.
    np.testing.assert_allclose(ours, np.concatenate(parts), atol=5e-5)
    low = 5 * shape[0]  # the input and two octaves
    np.testing.assert_allclose(ours[:low], np.concatenate(parts)[:low], atol=5e-7)


def test_zero_octaves_return_the_input(key):
    x = jax.random.normal(key, (3, 2))
    np.testing.assert_array_equal(positional_encoding(x, 0), x)
