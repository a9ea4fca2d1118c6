"""A whole method in fifty lines: the skinned template, each vertex in the mean colour of the pixels that see it."""

import safetensors.torch
import torch

from ash.capture.dataset import Pose
from ash.files import InputError
from ash.mesh.rasterizing import project_vertices, rasterize_mesh
from ash.template.template import skinned_template

IMAGES = {"ci": 8, "brief": 32, "cpu": 64}  # Budget: how many training images are looked at.


class PaintedMesh:
    def __init__(self, capture, seed, images):
        self.template, self.seed, self.images = skinned_template(capture), seed, images
        self.colours = torch.full((len(capture.template.vertices), 3), 0.5)

    def fit(self, capture, *, folder):
        views = capture.splits["train"].views
        order = torch.randperm(len(views), generator=torch.Generator().manual_seed(self.seed))
        total, count = torch.zeros_like(self.colours), torch.zeros(len(self.colours), 1)
        for name, frame in [views[i] for i in order[: self.images]]:
            seen, points = self._look(Pose(capture.motion, frame), capture.cameras[name])
            image = torch.from_numpy(capture.image(name, frame)).float() / 255
            x, y = (points[:, :2] / points[:, 2:]).long().unbind(1)
            inside = (x >= 0) & (y >= 0) & (x < image.shape[1]) & (y < image.shape[0])
            x, y = x * inside, y * inside
            seen_here = (inside & (points[:, 2] < seen.depth[y, x] + 0.02))[:, None] * image[y, x, 3:]
            total, count = total + seen_here * image[y, x, :3], count + seen_here
        self.colours = (total + 0.5) / (count + 1)

    def render(self, pose, camera, *, clock):
        with clock.stage("stg4"):
            seen, _ = self._look(pose, camera)
            corners = self.colours[self.template.faces[seen.triangle.clamp(min=0).long()]]
            colour = (corners * seen.barycentric[..., None]).sum(2)
            return torch.cat([colour, (seen.triangle >= 0)[..., None].float()], -1).numpy()

    def _look(self, pose, camera):  # A bad pose is refused by the template.
        viewmat, K = (torch.from_numpy(matrix).float() for matrix in (camera.viewmat, camera.K))
        points = project_vertices(self.template.pose(pose).vertices, viewmat, K)
        return rasterize_mesh(points, self.template.faces, width=camera.width, height=camera.height), points

    parameter_count, gaussian_count = (lambda self: self.colours.numel()), (lambda self: 0)

    def save(self, path):
        safetensors.torch.save_file({"colours": self.colours}, path)

    def load(self, path):
        self.colours = safetensors.torch.load_file(path)["colours"]


def painted(capture, *, seed, preset):
    if preset not in IMAGES:
        raise InputError(f"preset: expected one of {', '.join(IMAGES)}, got {preset!r}")
    return PaintedMesh(capture, seed, IMAGES[preset])
