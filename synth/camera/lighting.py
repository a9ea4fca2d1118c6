"""Light: the lamps around the person, the sky, and what gathers their light on a picture.

Mitsuba is handed in (`mi`), so that `synth/camera/render.py` stays the only file that imports it.
"""

from typing import Any

from synth.scene import Light


def make_lamps(mi: Any, light: Light) -> dict[str, Any]:
    """Area lights by name. They stand far away, so that light does not vary over the floor unless `falloff` asks."""

    def panel(position: tuple[float, ...], size: float, radiance: float, tint: tuple[float, ...], weight: float) -> Any:
        place = mi.ScalarTransform4f().look_at(origin=list(position), target=[0, 1, 0], up=[0, 1, 0.01])
        shape = mi.ScalarTransform4f().scale([size, size, 1])
        colour = {"type": "rgb", "value": [radiance * channel for channel in tint]}
        emitter = {"type": "area", "radiance": colour, "sampling_weight": weight}
        return mi.load_dict({"type": "rectangle", "to_world": place @ shape, "emitter": emitter})

    lamps = {}
    if light.area > 0:
        lamps["key"] = panel((10.4, 11.4, 12.8), 1.8, 40.0 * light.area, (1.0, 0.95, 0.87), 2.0)
        lamps["fill"] = panel((-13.6, 5.8, 6.4), 2.1, 14.7 * light.area, (0.86, 0.93, 1.0), 1.0)
        lamps["rim"] = panel((-2.4, 11.4, -14.4), 1.7, 25.5 * light.area, (1.0, 0.97, 0.93), 1.3)
    if light.falloff > 0:
        lamps["lamp"] = panel((1.7, 1.5, 0.2), 0.25, 36.0 * light.falloff, (1.0, 0.85, 0.65), 4.0)
    return lamps


def make_sky(mi: Any, light: Light) -> Any:
    """A constant environment. The material samples it, so lamps get the light samples (+1 dB at equal cost)."""
    return mi.load_dict({"type": "constant", "radiance": {"type": "rgb", "value": light.sky}, "sampling_weight": 0.1})


def is_plain(light: Light, *, depth: int, vectorised: bool) -> bool:
    """Whether `sky_and_lamps` can light the scene: direct light on diffuse cloth, and Dr.Jit to compile it."""
    return vectorised and depth <= 2 and light.gloss == 0 and light.area > 0


def make_integrator(mi: Any, light: Light, *, depth: int) -> Any:
    """Mitsuba's own way to gather light. A depth counts path edges: 2 is direct light only, 3 adds one bounce."""
    if depth <= 2:
        samples = 2 if light.gloss else 1  # Two kinds of reflection are noisier than one.
        return mi.load_dict({"type": "direct", "hide_emitters": True, "shading_samples": samples})
    return mi.load_dict({"type": "path", "max_depth": depth, "hide_emitters": True})


def sky_and_lamps(mi: Any, light: Light) -> Any:
    """Direct light on diffuse cloth: one sample of the sky by the material, and one of the lamps.

    Equal to `direct` in expectation and no noisier, in three quarters of its time: the sky is constant, so its ray need
    not find what it hits, and neither technique evaluates the other's density. The sky must not be in the scene, and
    `person` is to be set to a scene without lamps: pixels look past lamps that stand before or behind the person.
    """
    import drjit as dr

    class SkyAndLamps(mi.SamplingIntegrator):  # type: ignore[misc,name-defined]
        def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
            hit = self.person.ray_intersect(ray, mi.RayFlags.All, True, active)
            seen = active & hit.is_valid()
            material, context = hit.bsdf(ray), mi.BSDFContext()
            # A diffuse material needs no sample to choose among its parts. Drawing one would disturb the strata.
            way, weight = material.sample(context, hit, 0.5, sampler.next_2d(seen), seen)
            hidden = scene.ray_test(hit.spawn_ray(hit.to_world(way.wo)), seen)
            gathered = dr.select(hidden, 0, self.sky * weight)
            lamp, radiance = scene.sample_emitter_direction(hit, sampler.next_2d(seen), True, seen)
            gathered += radiance * material.eval(context, hit, hit.to_local(lamp.d), seen)
            return dr.select(seen, gathered, 0), seen, []

    integrator = SkyAndLamps(mi.Properties())
    integrator.sky = mi.Float(light.sky)
    dr.make_opaque(integrator.sky)
    return integrator
