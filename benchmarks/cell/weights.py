"""Where the weights of perceptual metrics are; needs no torch, so that cells without them need not wait for it."""

import os
from pathlib import Path

from ash.files import InputError

ENVIRONMENT = "ASH_BENCH_LPIPS_WEIGHTS"
HUB_FILE = "alexnet-owt-7be5be79.pth"


def weights_file() -> Path | None:
    """The backbone's weights: named by the user, or in torch's own cache; None where there are none.

    Raises:
        InputError: the user named a file that is not there.
    """
    named = os.environ.get(ENVIRONMENT)
    if named:
        if not Path(named).is_file():
            raise InputError(f"{named}: expected AlexNet's weights ({HUB_FILE} of torchvision)")
        return Path(named)
    home = Path(os.environ.get("TORCH_HOME", Path.home() / ".cache" / "torch"))
    cached = home / "hub" / "checkpoints" / HUB_FILE
    return cached if cached.is_file() else None
