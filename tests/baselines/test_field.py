"""The volume-rendered avatar: its renderer and its root finding against definitions, and each row's idea."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from helpers.captures import known_model, tube_template, write_tube_capture
from helpers.devices import META, _all_chosen, step_of, without_numbers
from helpers.figures import front_camera, tube_mesh, tube_motion, tube_skeleton
from helpers.scoring import foreground_psnr
from torch import Tensor, nn

from ash.capture.dataset import Capture, Motion, Pose
from ash.config import TemplateConfig
from ash.files import InputError
from ash.presets import MethodFactory
from ash.protocol import StageClock
from ash.training import loop, stopping
from ash.training.adam import Adam
from ash.training.batches import draw_batch
from ash.training.images import load_training_images
from baselines import field
from baselines.field import (
    FieldAvatar,
    FieldConfig,
    ForwardField,
    JointFrame,
    Mlp,
    Rays,
    SurfaceLookup,
    build_shell_grid,
    draw_rays,
    draw_view,
    hdhumans,
    joint_frame,
    march,
    march_naive,
    neural_actor,
    rays_of,
    ring_of,
    tava,
)

ROWS: dict[str, MethodFactory[FieldConfig]] = {
    "tava": tava,
    "neural_actor": neural_actor.with_overrides({"field.surface": "template"}),
    "hdhumans": hdhumans,
}
SMALL = {
    "model.texels": 16, "model.width": 4, "model.levels": 2, "model.window": 2,
    "field.rays": 96, "field.samples": 12, "field.width": 32, "field.layers": 2, "field.side_width": 32,
    "field.octaves": 6, "training.learning_rate": 4e-3, "training.base_learning_rate": 2e-2, "training.ema": 0.0,
}  # fmt: skip


def made(row: str, capture: Capture, **changes: Any) -> FieldAvatar:
    overrides = SMALL | {key.replace("__", "."): value for key, value in changes.items()}
    return FieldAvatar.from_capture(ROWS[row].with_overrides(overrides).config("ci"), capture)


# ---- the renderer


class Ball(nn.Module):
    """A soft ball of radius 0.2 at the origin whose colour varies in space, with numbers to learn."""

    def __init__(self) -> None:
        super().__init__()
        self.dense, self.radius = nn.Parameter(torch.tensor(2.3)), nn.Parameter(torch.tensor(0.2))
        self.waves = nn.Parameter(torch.randn(3, 3, generator=torch.manual_seed(0)))

    def forward(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        inside = ((self.radius - points.norm(dim=-1)) / 0.02).sigmoid()
        return self.dense.exp() * inside, (5 * points @ self.waves + directions).sigmoid()


def ball_and_rays() -> tuple[Ball, Rays, field.ShellGrid]:
    """The shell is around two thirds of the ball and a point apart from it: rays enter it, leave it and enter it."""
    random = torch.Generator().manual_seed(1)
    surface = nn.functional.normalize(torch.randn(4000, 3, generator=random), dim=-1) * 0.2
    points = torch.cat([surface[surface[:, 1] < 0.07], torch.tensor([[0.0, 0.0, 0.6]])])
    grid = build_shell_grid(points, reach_m=0.12, extent_m=1.5)
    origins = torch.tensor([[0.0, 0.0, 2.0]]) + 0.1 * torch.randn(60, 3, generator=random)
    towards = 0.7 * torch.rand(60, 3, generator=random) - 0.35 - origins
    return Ball(), Rays(origins=origins, directions=nn.functional.normalize(towards, dim=-1)), grid


def test_marching_is_the_integral_in_value_and_gradient() -> None:
    ball, rays, grid = ball_and_rays()
    weights = torch.randn(60, 3, generator=torch.manual_seed(2))
    found = []
    for marched in (march(ball, rays, grid, samples=400), march_naive(ball, rays, grid, steps=800)):
        ball.zero_grad()
        ((marched.rgb * weights).sum() + marched.alpha.sum()).backward()
        found.append((marched, [p.grad.clone() for p in ball.parameters()]))
    (fast, gradients), (exact, wanted) = found
    assert exact.alpha.std() > 0.05 and exact.alpha.max() > 0.8
    torch.testing.assert_close(fast.rgb, exact.rgb, atol=1.5e-2, rtol=0)
    torch.testing.assert_close(fast.alpha, exact.alpha, atol=1.5e-2, rtol=0)
    for gradient, truth in zip(gradients, wanted, strict=True):
        torch.testing.assert_close(gradient, truth, rtol=0.02, atol=0.02 * float(truth.abs().max()))


def test_light_falls_off_as_the_exponential_of_what_lies_in_the_shell() -> None:
    grid = build_shell_grid(torch.zeros(1, 3), reach_m=0.1, extent_m=0.5)
    rays = Rays(origins=torch.tensor([[0.0, 0.0, 1.0], [0.3, 0.0, 1.0]]), directions=torch.tensor([[0.0, 0, -1]] * 2))
    marched = march(lambda p, d: (torch.full_like(p[:, 0], 3.0), torch.ones_like(p)), rays, grid, samples=4)
    lengths = field.stretches_in(grid, rays).length
    assert 0.2 <= float(lengths[0]) <= 0.25 and float(lengths[1]) == 0
    torch.testing.assert_close(marched.alpha, 1 - torch.exp(-3 * lengths))


def test_jittered_samples_stay_in_their_strata_and_in_the_shell() -> None:
    _, rays, grid = ball_and_rays()
    stretches = field.stretches_in(grid, rays)
    hit = stretches.length > 0
    share = (torch.arange(32) + torch.rand(60, 32, generator=torch.manual_seed(3))) / 32
    places = stretches.place(share)[hit]
    assert hit.any() and (places.diff(dim=1) >= 0).all()
    assert grid.contains(rays[hit].at(places)).float().mean() > 0.95  # Bins at the border are taken whole.
    edges = stretches.place(torch.arange(33).expand(60, -1) / 32)[hit]
    assert (places >= edges[:, :-1] - 1e-5).all() and (places <= edges[:, 1:] + 1e-5).all()


def test_drawing_ends_early_and_draws_what_training_sees() -> None:
    ball, rays, grid = ball_and_rays()
    ball.dense.data.fill_(6.0)
    asked = []

    def counted(points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        asked.append(len(points))
        return ball(points, directions)

    drawn = draw_rays(counted, rays, grid, samples=64)
    with torch.no_grad():
        whole = march(ball, rays, grid, samples=64)
    torch.testing.assert_close(drawn, torch.cat([whole.rgb, whole.alpha[:, None]], 1), atol=2e-3, rtol=0)
    assert sum(asked) < 0.8 * 64 * 60
    camera = front_camera(20, 16)
    image = draw_view(ball, camera, grid, samples=16)
    assert image.shape == (16, 20, 4) and image[..., 3].max() > 0.5 > image[..., 3].min() == 0


def test_rays_go_through_the_pixels_that_cameras_project_to() -> None:
    camera = front_camera(40, 30)
    pixels = torch.tensor([0, 39, 40 * 29 + 7])
    rays = rays_of(camera, pixels)
    projected, depth = camera.project((rays.origins + 2 * rays.directions).double().numpy())
    assert (depth > 0).all()
    np.testing.assert_allclose(projected, np.array([[0.5, 0.5], [39.5, 0.5], [7.5, 29.5]]), atol=1e-4)


def test_the_nearest_point_is_the_nearest_point() -> None:
    posed = tube_template().pose(Pose(tube_motion(), 3))
    faces = torch.from_numpy(tube_mesh().faces)
    lookup = SurfaceLookup(posed, faces, ring_of(tube_mesh().faces, len(posed.vertices)))
    random = torch.Generator().manual_seed(4)
    rows = torch.randint(len(faces), (200,), generator=random)
    height = 0.04 * torch.randn(200, 1, generator=random)
    points = posed.vertices[faces[rows]].mean(1) + height * posed.normals[faces[rows, 0]]
    near = lookup.of(points)
    mesh = trimesh.Trimesh(posed.vertices.numpy(), faces.numpy(), process=False)
    _, distance, _ = trimesh.proximity.closest_point_naive(mesh, points.numpy())
    np.testing.assert_allclose(near.distance.abs().numpy(), distance, atol=2e-3)
    assert ((near.distance > 0) == (height[:, 0] > 0)).float().mean() > 0.98
    torch.testing.assert_close(near.weights.sum(1), torch.ones(200))


# ---- the root


def elbow() -> tuple[ForwardField, JointFrame]:
    """A field with random networks, in a pose that is bent by 70 degrees."""
    torch.manual_seed(5)
    net = ForwardField(replace(tava.config("ci").field, side_width=16), tube_skeleton())
    for parameter in net.parameters():
        parameter.data += 0.05 * torch.randn_like(parameter)
    dofs = torch.tensor([0.1, 0.0, -0.1, 0.2, 0.3, 0.1, 0.0, 0.1, 1.2], dtype=torch.float64)
    net = net.double()
    net.bones = replace(net.bones, starts=net.bones.starts.double(), ends=net.bones.ends.double())
    return net, joint_frame(tube_skeleton(), dofs)


def newton(net: ForwardField, points: Tensor, frame: JointFrame, start: Tensor) -> Tensor:
    for _ in range(8):
        start = net.implicit(start, points, frame)[0].detach()
    return start


def test_distances_to_bones_are_those_to_their_nearest_points() -> None:
    net, frame = elbow()
    points = torch.rand(50, 3, generator=torch.manual_seed(10)).double() * 2 - 0.5
    along = net.bones.along(torch.linspace(0, 1, 2001).double()[None, :, None].expand(len(net.bones.joints), -1, -1))
    joints = frame.matrices[net.bones.joints].unflatten(1, (3, 4))
    posed = along @ joints[..., :3].transpose(1, 2) + joints[:, None, :, 3]
    for found, lines in (
        (net.bones.distances(points, None), along),
        (net.bones.distances(points, frame.matrices), posed),
    ):
        expected = (points[:, None, None] - lines).norm(dim=-1).amin(2)
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)
    single = replace(net.bones, starts=net.bones.starts.float(), ends=net.bones.ends.float())
    torch.testing.assert_close(
        single.distances(points.float(), None).double(), net.bones.distances(points, None), atol=1e-3, rtol=0
    )


def test_numbers_that_all_points_share_are_inputs_like_others() -> None:
    torch.manual_seed(11)
    net = Mlp(7, 2, width=8, layers=2)
    inputs, shared = torch.randn(5, 4), torch.randn(3)
    torch.testing.assert_close(net.beside(inputs, shared), net(torch.cat([inputs, shared.expand(5, -1)], 1)))


def test_a_root_is_posed_to_where_it_was_asked_for() -> None:
    net, frame = elbow()
    rest = torch.rand(300, 3, generator=torch.manual_seed(6)).double() * torch.tensor([0.2, 1.0, 0.2])
    points = net.pose(rest, frame)[0].detach()
    roots, are_roots = net.search(points, frame)
    assert are_roots.any(1).float().mean() > 0.95
    back = net.pose(roots[are_roots], frame)[0]
    wanted = points[:, None].expand(-1, roots.shape[1], -1)[are_roots]
    assert (back - wanted).norm(dim=-1).max() <= field.ROOT_M


def test_the_root_has_the_gradient_of_finite_differences() -> None:
    net, frame = elbow()
    rest = torch.rand(20, 3, generator=torch.manual_seed(7)).double() * torch.tensor([0.2, 1.0, 0.2])
    points = net.pose(rest, frame)[0].detach()
    start = newton(net, points, frame, rest)
    weights = torch.randn(20, 3, generator=torch.manual_seed(8)).double()
    root, _, solid = net.implicit(start, points, frame)
    assert solid.all()
    torch.testing.assert_close(root, start)
    (root * weights).sum().backward()
    for parameter in (net.skin[0].weight, net.skin[-1].bias, net.offset[0].bias, net.offset[-1].weight):
        values, gradient = parameter.data.view(-1), parameter.grad.reshape(-1)
        for place in gradient.abs().topk(3).indices.tolist():
            kept, results = float(values[place]), []
            for sign in (1, -1):
                values[place] = kept + sign * 1e-5
                results.append(float((newton(net, points, frame, start) * weights).sum()))
            values[place] = kept
            assert float(gradient[place]) == pytest.approx((results[0] - results[1]) / 2e-5, rel=1e-4)


# ---- the ideas


def bending(frames: int) -> Motion:
    """The elbow bends to 75 degrees and back, and the root turns a little."""
    dofs = np.zeros((frames, 9))
    dofs[:, 8] = 1.3 * np.sin(np.linspace(0.4, 2.7, frames))
    dofs[:, 4] = np.linspace(-0.3, 0.3, frames)
    return Motion(dofs=dofs, sequence=np.zeros(frames, dtype=np.int64), fps=25.0)


STRIPES = torch.tensor([0.0, 2.0, 4.0])


class Wrinkled:
    """`known_model` with stripes along the tube that come and go with the bend, as wrinkles do."""

    def __init__(self) -> None:
        self.model = known_model()
        self.template = self.model.template

    def __call__(self, pose: Pose, camera: Any) -> Any:
        height = self.model.lattice.interpolate(self.template.pose(pose).canonical)[:, 1]
        strength = 4 * float(np.sin(3 * pose.dofs[8]))
        self.model.base_texels.data[:, 11:14] = strength * torch.sin(25 * height[:, None] + STRIPES)
        return self.model(pose, camera)


@pytest.fixture
def unscored(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reserved views are looked at in the end alone."""
    monkeypatch.setattr(stopping, "FIRST_MARK", 1000)


def learned(row: str, capture: Capture, folder: Path, **changes: Any) -> FieldAvatar:
    """Trained for a few seconds."""
    avatar = made(row, capture.training_only(), **changes)
    avatar.fit(capture.training_only(), folder=folder)
    return avatar


def posed_tube(bend: float, random: torch.Generator) -> tuple[JointFrame, Tensor, Tensor]:
    """Points in and around the tube about its elbow, posed with its own soft weights; colour times whether inside."""
    frame = joint_frame(tube_skeleton(), torch.tensor([0.0] * 8 + [bend]))
    height, angle, radius = torch.rand(3, 400, generator=random)
    height, angle, radius = 0.25 + 0.5 * height, 2 * torch.pi * angle, 0.14 * radius
    rest = torch.stack([radius * angle.sin(), height, radius * angle.cos()], -1)
    upper = ((height - 0.35) / 0.3).clamp(0, 1)[:, None]
    blended = ((1 - upper) * frame.matrices[0] + upper * frame.matrices[1]).unflatten(1, (3, 4))
    posed = (blended[..., :3] @ rest[..., None])[..., 0] + blended[..., 3]
    return frame, posed, (0.5 + 0.5 * torch.sin(25 * height[:, None] + STRIPES)) * (radius < 0.1)[:, None]


def elbow_error(root_steps: int) -> float:
    """Of a field that learned from four bends, rms in two others."""
    torch.manual_seed(0)
    settings = replace(tava.config("ci").field, root_steps=root_steps, width=32, layers=2, octaves=6, side_width=32)
    net, random = ForwardField(settings, tube_skeleton()), torch.Generator().manual_seed(9)
    optimiser = Adam([{"params": [*net.parameters()], "lr": 5e-3}])

    def error(bend: float) -> Tensor:
        frame, points, wanted = posed_tube(bend, random)
        density, rgb = net.at(frame)(points, torch.zeros_like(points))
        return (rgb * (1 - torch.exp(-0.02 * density))[:, None] - wanted).square().mean()

    for step in range(200):
        optimiser.zero_grad()
        share = torch.rand(len(net.bones.joints), 8, 1, generator=random)
        (error((-1.2, -0.4, 0.4, 1.2)[step % 4]) + 0.1 * net.bone_loss(share)).backward()
        optimiser.step()
    with torch.no_grad():
        return float(torch.stack([error(bend) for bend in (-0.8, 0.8)]).mean().sqrt())


def test_root_finding_beats_the_nearest_bone_at_an_elbow() -> None:
    errors = {steps: elbow_error(steps) for steps in (0, 8)}
    assert errors[8] < 0.75 * errors[0], errors


@pytest.mark.usefixtures("unscored")
def test_texture_features_beat_none_where_looks_follow_the_motion(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("helpers.captures.tube_motion", bending)
    monkeypatch.setattr("helpers.captures.known_model", Wrinkled)
    capture = write_tube_capture(tmp_path / "capture")
    scores = {}
    for channels in (0, 8):
        avatar = learned(
            "neural_actor",
            capture,
            tmp_path / str(channels),
            training__steps=250,
            training__learning_rate=5e-3,
            field__channels=channels,
        )
        scores[channels] = foreground_psnr(avatar, capture, capture.splits["novel_view"].views)
    assert scores[8] > scores[0] + 0.5, scores


@pytest.mark.usefixtures("unscored")
def test_the_pull_mends_a_wrong_template(capture: Capture, tmp_path: Path) -> None:
    """A template that is a centimetre too thin: the one that is pulled comes nearer to the truth."""
    thin = replace(capture.template, vertices=capture.template.vertices * [0.9, 1.0, 0.9])
    wrong, pose = replace(capture, template=thin), Pose(capture.motion, 1)
    truth, errors = known_model().template.pose(pose).vertices.numpy(), {}
    for every, steps in ((0, 4), (3, 120)):  # Without a pull there is nothing that could move it.
        changes = {"field__pull_every": every, "training__steps": steps, "training__base_learning_rate": 0.1}
        avatar = learned("hdhumans", wrong, tmp_path / str(every), **changes)
        errors[every] = float(np.sqrt(((avatar.template_vertices(pose) - truth) ** 2).sum(1).mean()))
    assert errors[0] == pytest.approx(0.01, abs=0.002)
    assert errors[3] < 0.85 * errors[0], errors


# ---- as a method


class Stopped(Exception):
    """The machine went down."""


@pytest.mark.parametrize("row", ROWS)
def test_a_stopped_training_ends_with_the_same_bits(
    row: str, capture: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop, "CHECKPOINT_SECONDS", -1.0)
    size = {"training__steps": 9, "field__warmup_steps": 3, "field__rays": 48}
    whole = made(row, capture, **size)
    whole.fit(capture.training_only(), folder=tmp_path / "whole")
    broken = made(row, capture, **size)
    loss = broken.loss

    def stopping(batches: Any, step: int) -> Tensor:
        if step == 5:
            raise Stopped
        return loss(batches, step)

    monkeypatch.setattr(broken, "loss", stopping)
    with pytest.raises(Stopped):
        broken.fit(capture.training_only(), folder=tmp_path / "part")
    resumed = made(row, capture, **size)
    resumed.fit(capture.training_only(), folder=tmp_path / "part")
    for name, value in whole.module.state_dict().items():
        assert torch.equal(value, resumed.module.state_dict()[name]), name
    resumed.save(tmp_path / "weights.safetensors")
    loaded = made(row, capture, **size, seed=1)
    loaded.load(tmp_path / "weights.safetensors")
    pose, camera = Pose(capture.motion, 5), capture.cameras["cam0"]
    images = [avatar.render(pose, camera, clock=StageClock()) for avatar in (whole, loaded)]
    np.testing.assert_array_equal(*images)
    assert images[0].dtype == np.float32 and images[0].shape == (48, 48, 4)
    assert (images[0][..., :3] <= images[0][..., 3:] + 1e-6).all()


PUBLISHED = {
    "tava": {"trunk": [256] * 8 + [257], "rays": 1024, "samples": 128, "skin": [128] * 4, "roots": (5, 50)},
    "neural_actor": {"trunk": [256] * 6 + [257], "rays": 1024, "samples": 64, "channels": 512},
    "hdhumans": {"trunk": [256] * 6 + [257], "rays": 1024, "samples": 64, "channels": 512},
}


@pytest.mark.parametrize("row", ROWS)
def test_the_published_size_makes_a_step_without_numbers(
    row: str, capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_numbers(monkeypatch)
    monkeypatch.setattr(Tensor, "nonzero", _all_chosen)
    config = ROWS[row].config("paper")
    published = PUBLISHED[row]
    assert (config.field.rays, config.field.samples) == (published["rays"], published["samples"])
    assert config.training.steps == 300_000 and config.field.channels == published.get("channels", 0)
    few = replace(config, template=TemplateConfig(), field=replace(config.field, root_steps=2))
    avatar = FieldAvatar.from_capture(few, capture)
    radiance: Any = avatar.module.field.radiance
    assert [layer.out_features for layer in radiance.trunk if isinstance(layer, nn.Linear)] == published["trunk"]
    if row == "tava":
        skin: Any = avatar.module.field.skin
        assert [layer.out_features for layer in skin if isinstance(layer, nn.Linear)][:-1] == published["skin"]
        assert (config.field.candidates, config.field.root_steps) == published["roots"]
    learned = step_of(avatar, capture, META)
    assert learned and all(parameter.device == META for parameter in learned)
    if row == "hdhumans":  # A step that pulls moves the template and nothing else.
        avatar.module.zero_grad()
        avatar.loss([draw_batch(load_training_images(capture, META), avatar.config.training, 0, 3)], 3).backward()
        assert [name for name, p in avatar.module.named_parameters() if p.grad is not None] == ["refinement.rough"]


def test_what_cannot_be_is_refused() -> None:
    config = tava.config("ci").field
    for changes in ({"kind": "cloud"}, {"rays": 0}, {"shell_m": 0.0}, {"pull_every": 1}, {"candidates": 0}):
        with pytest.raises(InputError):
            replace(config, **changes)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="preset: expected one of"):
        tava.config("nosuch")
