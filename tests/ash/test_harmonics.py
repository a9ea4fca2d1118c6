import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y

from ash.harmonics import rotate_sh, sh_basis
from ash.rotations import quat_conjugate, rotate


def directions(count: int) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.randn(count, 3, dtype=torch.float64), dim=-1)


def test_basis_is_the_real_form_of_scipys_harmonics():
    d = directions(200)
    x, y, z = d.numpy().T
    theta, phi = np.arccos(z), np.arctan2(y, x)
    columns = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            complex_value = sph_harm_y(degree, abs(order), theta, phi)
            # 3D Gaussian splatting keeps the Condon-Shortley sign of the complex harmonics.
            real = complex_value.imag if order < 0 else complex_value.real
            columns.append(real * (np.sqrt(2) if order else 1))
    np.testing.assert_allclose(sh_basis(d, 3).numpy(), np.stack(columns, -1), atol=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_rotated_harmonics_are_the_same_function_seen_from_the_rotated_frame(degree):
    quats = torch.nn.functional.normalize(torch.randn(30, 4, dtype=torch.float64), dim=-1)
    sh = torch.randn(30, (degree + 1) ** 2, 3, dtype=torch.float64)
    d = directions(30)
    value = (sh_basis(d, degree)[..., None] * rotate_sh(quats, sh)).sum(1)
    expected = (sh_basis(rotate(quat_conjugate(quats), d), degree)[..., None] * sh).sum(1)
    torch.testing.assert_close(value, expected, atol=1e-12, rtol=0)
