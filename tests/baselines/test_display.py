"""The mesh baseline drawn by OpenGL is the picture that it was trained with."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from ash.capture.dataset import Capture
from ash.files import InputError
from baselines.display import pyrender_or_refuse

# A process of its own: an EGL driver brings an LLVM along, and so does the path tracer of other tests.
DRIVER = """
import json, sys
from dataclasses import replace
from pathlib import Path
import numpy as np
import torch
from ash.capture.dataset import Pose
from ash.capture.formats import load_capture
from ash.files import InputError
from ash.presets import plus
from ash.protocol import StageClock
from baselines.ddc import DdcAvatar, ddc_config

capture, scratch = load_capture(Path(sys.argv[1])), Path(sys.argv[2])
ash = plus("ci")
model = replace(ash.model, texels=16, shuffle=1, width=4, levels=2, window=2)
training = replace(ash.training, steps=25, warmup_steps=5)
config = ddc_config(replace(ash, model=model, training=training), seed=0, template=ash.template)
avatar = DdcAvatar.from_capture(config, capture)
avatar.fit(capture, folder=scratch)
avatar.module.base_texture.data -= 0.3  # As training may leave it: with colours below zero.
avatar.module.light.data = 0.05 * torch.randn(9, 3, generator=torch.Generator().manual_seed(0))
try:
    display = avatar.open_display()
except InputError as error:
    print(error)
    sys.exit(77)
found = []
for width, height in ((48, 48), (80, 56), (48, 48)):
    for name, frame in capture.splits["novel_view"].views[:3]:
        camera = capture.cameras[name]
        K = camera.K + np.array([[0, 0, 0.37], [0, 0, 0.71], [0, 0, 0]])  # No edge passes through a pixel's centre.
        camera = replace(camera, width=width, height=height, K=K)
        clock = StageClock()
        drawn = display.render(Pose(capture.motion, frame), camera, clock=clock)
        trained = avatar.render(Pose(capture.motion, frame), camera, clock=StageClock())
        inside = trained[..., 3] > 0.5
        error = np.mean((drawn - trained)[inside, :3] ** 2)
        found.append([drawn.shape, str(drawn.dtype), -10 * float(np.log10(error)),
                      float(np.abs(drawn - trained)[..., 3].mean()), bool(inside.any()), sorted(clock.ms)])
display.close()
print(json.dumps(found))
"""


def test_opengl_draws_what_the_training_renderer_draws(capture: Capture, tmp_path: Path) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "PYOPENGL_PLATFORM"}
    command = [sys.executable, "-c", DRIVER, str(capture.folder), str(tmp_path / "run")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode == 77:
        pytest.skip(f"no off-screen OpenGL: {done.stdout.strip()}")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert [tuple(row[0][:2]) for row in found] == [(48, 48)] * 3 + [(56, 80)] * 3 + [(48, 48)] * 3
    for _, dtype, psnr, alpha_error, is_seen, stages in found:
        assert dtype == "float32" and is_seen and stages == ["stg1", "stg2", "stg3", "stg4"]
        assert psnr > 40
        assert alpha_error < 1e-3


def test_a_platform_with_a_screen_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYOPENGL_PLATFORM", "glx")
    with pytest.raises(InputError, match="expected egl or osmesa"):
        pyrender_or_refuse()
