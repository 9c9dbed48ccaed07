"""One view under one light, prepared for trying biases: nothing is rasterized again.

The two passes, the places of all pixels in the map and, for biases that act on depth
alone, what the filter reads there are computed once. A trial is then a comparison per pixel.
Pixels turned away from the light are dark whatever the bias, so they are left out.
"""

import abc
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from shadows.area_lights import AreaLight
from shadows.bias import Bias, CombinedBias
from shadows.compare import Compare, HardCompare
from shadows.filters import Filter, look_up
from shadows.layouts import Layout, SingleLayout
from shadows.render import Rendering
from shadows.shadow_map import Receiver, ShadowMap
from shadows.visibility import receive_surface
from tangentspace._math import dot
from tangentspace.shading import Shading

from ..checks import check_shadow_map
from ..metrics import (
    ShadowErrors,
    SoftShadowErrors,
    contact_gap,
    shadow_errors,
    soft_shadow_errors,
)
from ..rendering.render_scene import render_scene, shade_scene
from ..scene import Scene
from ..truth.area import seen_share
from ..truth.rays import Occluders, nearest_occluder_distance

Techniques = tuple[CombinedBias, Filter, Compare]


class Goal(eqx.Module):
    """What visibility is compared with, at the pixels that face the light.

    Attributes:
        unit: What ``error`` counts.
    """

    unit: ClassVar[str]

    @abc.abstractmethod
    def residual(self, visibility: Float[Array, " pixels"]) -> Float[Array, "..."]:
        """Return what a least-squares fit makes small."""

    @abc.abstractmethod
    def error(self, visibility: Float[Array, " pixels"]) -> Float[Array, ""]:
        """Return what counts in the end."""


class TruthGoal(Goal):
    """Ray-traced visibility.

    Attributes:
        truth: 1 where lit.
        surface_count: Pixels with a surface, of which ``error`` is a share.
    """

    unit: ClassVar[str] = "share of wrong pixels"
    truth: Float[Array, " pixels"]
    surface_count: Float[Array, ""]

    def residual(self, visibility: Float[Array, " pixels"]) -> Float[Array, " pixels"]:
        """Return visibility minus truth."""
        return visibility - self.truth

    def error(self, visibility: Float[Array, " pixels"]) -> Float[Array, ""]:
        """Return the share of surface pixels on the wrong side of one half."""
        wrong = jnp.where(self.truth > 0.5, visibility <= 0.5, visibility >= 0.5)
        return jnp.sum(wrong) / self.surface_count


class ShareGoal(Goal):
    """Ray-traced visibility of an area light.

    Attributes:
        share: Of the light, that is seen.
    """

    unit: ClassVar[str] = "rms of visibility at pixels that face the light"
    share: Float[Array, " pixels"]

    def residual(self, visibility: Float[Array, " pixels"]) -> Float[Array, " pixels"]:
        """Return visibility minus truth."""
        return visibility - self.share

    def error(self, visibility: Float[Array, " pixels"]) -> Float[Array, ""]:
        """Return the root mean square of the residual."""
        return jnp.sqrt(jnp.mean(self.residual(visibility) ** 2))


class ImageGoal(Goal):
    """A target image; the color is ``unlit + visibility * direct``.

    Attributes:
        unlit: Color in full shadow.
        direct: What the light adds.
        target: Linear RGB.
        limit: Where the target's format saturates: 1 for PNG, infinity for EXR.
    """

    unit: ClassVar[str] = "rms of linear radiance at pixels that face the light"
    unlit: Float[Array, "pixels 3"]
    direct: Float[Array, "pixels 3"]
    target: Float[Array, "pixels 3"]
    limit: Float[Array, ""]

    def residual(self, visibility: Float[Array, " pixels"]) -> Float[Array, "pixels 3"]:
        """Return color minus target."""
        color = self.unlit + visibility[:, None] * self.direct
        return jnp.minimum(color, self.limit) - self.target

    def error(self, visibility: Float[Array, " pixels"]) -> Float[Array, ""]:
        """Return the root mean square of the residual."""
        return jnp.sqrt(jnp.mean(self.residual(visibility) ** 2))


class Trial(NamedTuple):
    """What trying a bias needs, at the pixels that face the light.

    Attributes:
        receiver: The pixels in the map, without bias.
        reading: What the filter reads there while no texel moves.
        shadow_map: For biases and filters that read anew.
        goal: What visibility is compared with.
        soft: Whether the light has a size, and truth penumbrae.
    """

    receiver: Receiver
    reading: PyTree
    shadow_map: ShadowMap
    goal: Goal
    soft: bool = False

    def visibility(
        self, bias: Bias, filter: Filter, compare: Compare, *, anew: bool = False
    ) -> Float[Array, " pixels"]:
        """Return the visibility of the facing pixels under a bias.

        Args:
            bias: Against self-shadowing.
            filter: How the map is asked.
            compare: Hard or soft.
            anew: Whether the filter is not the one that ``reading`` is of.
        """
        receiver = bias(self.receiver, filter.reach())
        if anew or bias.reads_anew or filter.reads_anew:
            shadow_map = bias.prepare(self.shadow_map)
            return look_up(shadow_map, receiver, filter=filter, compare=compare)
        return filter.visibility(self.reading, receiver, compare)

    def error(self, bias: Bias, filter: Filter) -> Float[Array, ""]:
        """Return the goal's error under hard comparison."""
        return self.goal.error(self.visibility(bias, filter, HardCompare()))

    @property
    def footprint_length(self) -> Float[Array, ""]:
        """Median texel footprint of the pixels as a world length along the light ray."""
        slanted = jnp.median(self.receiver.footprint / jnp.abs(self.receiver.depth_rate))
        return jnp.maximum(slanted, 0.05 * jnp.median(self.receiver.texel_length))


class Study(NamedTuple):
    """A view with its truth, on which biases are judged.

    Attributes:
        scene: What is seen.
        unbiased: The view with zero bias, with both passes.
        filter: How the map is asked.
        compare: How depths become visibility in the end.
        shading: How the pictures are lit.
        truth: Ray-traced visibility; of an area light, whether more than half of it is seen.
        share: Of the light that is seen; 0 or 1 but for area lights.
        occluder_distance: World length along the ray to what hides the light, or its centre;
            inf if nothing does.
        facing: Pixels whose face is turned to the light.
        trial: What fits and sweeps work on.
    """

    scene: Scene
    unbiased: Rendering
    filter: Filter
    compare: Compare
    shading: Shading
    truth: Bool[np.ndarray, "height width"]
    share: Float[np.ndarray, "height width"]
    occluder_distance: Float[np.ndarray, "height width"]
    facing: Bool[np.ndarray, "height width"]
    trial: Trial

    @property
    def soft(self) -> bool:
        """Whether the light has a size, and truth penumbrae."""
        return self.trial.soft

    def visibility(self, bias: Bias | Techniques) -> Float[np.ndarray, "height width"]:
        """Return the image of visibility under a bias, or under other techniques too."""
        image = np.zeros(self.facing.shape, np.float32)
        image[self.facing] = self._at_pixels(bias)
        return image

    def _at_pixels(self, bias: Bias | Techniques) -> Float[Array, " pixels"]:
        given = bias if isinstance(bias, tuple) else (bias, self.filter, self.compare)
        anew = isinstance(bias, tuple) and not eqx.tree_equal(bias[1], self.filter)
        return tried_visibility(self.trial, given, bool(anew))

    def errors(self, bias: Bias | Techniques) -> ShadowErrors:
        """Judge a bias against the ray-traced truth."""
        covered = np.asarray(self.unbiased.surface.covered)
        return shadow_errors(self.visibility(bias), self.truth, covered)

    def soft_errors(self, bias: Bias | Techniques) -> SoftShadowErrors:
        """Judge a bias against the share of the light that is seen."""
        covered = np.asarray(self.unbiased.surface.covered)
        return soft_shadow_errors(self.visibility(bias), self.share, covered)

    def objective(self, bias: Bias | Techniques) -> float:
        """Return the goal's error of a bias."""
        return float(self.trial.goal.error(self._at_pixels(bias)))

    def contact_gap(self, bias: Bias | Techniques) -> float:
        """Return the world length of full shadow that a bias takes away at contacts."""
        surface = self.unbiased.surface
        to_light = self.scene.lights[0].to_light(surface.position)
        sin_angle = np.sqrt(np.maximum(1 - np.asarray(dot(surface.face_normal, to_light)) ** 2, 0))
        return contact_gap(
            self.visibility(bias),
            self.share > 0,
            np.asarray(surface.covered),
            self.occluder_distance,
            sin_angle,
        )

    def picture(
        self, visibility: Float[np.ndarray, "height width"]
    ) -> Float[np.ndarray, "height width 3"]:
        """Return the image, linear RGB, lit with a given visibility."""
        lights = self.scene.lights[:1]
        color = shade_scene(self.scene, self.unbiased, lights, [visibility], self.shading)
        return np.asarray(color)


@eqx.filter_jit
def tried_visibility(trial: Trial, techniques: tuple, anew: bool) -> Float[Array, " pixels"]:
    """Return the visibility of the facing pixels."""
    bias, filter, compare = techniques
    return trial.visibility(bias, filter, compare, anew=anew)


def prepare_study(
    scene: Scene,
    *,
    image_size: tuple[int, int],
    map_size: int,
    filter: Filter,
    shading: Shading,
    bias: CombinedBias = CombinedBias(),
    compare: Compare = HardCompare(),
    layout: Layout = SingleLayout(),
) -> Study:
    """Make both passes and trace the truth; the goal is that truth.

    Of an area light truth is the share that is seen, by a ray to each of 64 points on it.

    Args:
        scene: What is seen; its first light counts.
        image_size: Height and width in pixels.
        map_size: Texels on each side of the shadow map.
        filter: How the map is asked.
        shading: The lighting model of the pictures.
        bias: What will be tried; says which surfaces cast.
        compare: How depths become visibility in the end.
        layout: How many maps serve the light.

    Raises:
        ValueError: If nothing that is seen faces the light, or nothing is in its view.
    """
    scene = scene._replace(lights=scene.lights[:1])
    filter = filter.for_light(scene.lights[0])
    unbiased = render_scene(
        scene,
        image_size=image_size,
        map_size=map_size,
        bias=CombinedBias(tuple(term for term in bias.terms if term.casters != "nearest")),
        filter=filter,
        compare=compare,
        shading=shading,
        layout=layout,
    )
    light, surface, shadow_map = scene.lights[0], unbiased.surface, unbiased.shadow_maps[0]
    check_shadow_map(scene, shadow_map, casters=bias.casters)
    reach = filter.reach()
    receiver = jax.jit(receive_surface)(surface, light, shadow_map, reach=reach)
    facing = np.asarray(surface.covered & (dot(receiver.normal, receiver.to_light) > 0))
    if not facing.any():
        raise ValueError(f"{scene.name}: no visible surface faces the light; move light or camera")
    occluders = Occluders(scene.mesh.positions, scene.mesh.faces)
    position, normal = np.asarray(surface.position), np.asarray(surface.face_normal)
    points = (position, normal, np.asarray(surface.face_ids))
    share = seen_share(*points, light, occluders)
    if isinstance(light, AreaLight):
        goal = ShareGoal(jnp.asarray(share[facing], jnp.float32))
    else:
        count = jnp.sum(surface.covered).astype(jnp.float32)
        goal = TruthGoal(jnp.asarray(share[facing], jnp.float32), count)
    distance = nearest_occluder_distance(*points, light, occluders)

    at_pixels = _at_pixels(receiver, facing)
    reading = filter.read(filter.prepare(bias.prepare(shadow_map)), at_pixels)
    trial = Trial(at_pixels, reading, shadow_map, goal, isinstance(light, AreaLight))
    seen = (share > 0.5, share, distance, facing)
    return Study(scene, unbiased, filter, compare, shading, *seen, trial)


def _at_pixels(receiver: Receiver, chosen: Bool[np.ndarray, "height width"]) -> Receiver:
    """Return the receivers of some pixels."""
    shared = {"texel_from_world": receiver.texel_from_world}
    kept = receiver._replace(texel_from_world=None)
    return jax.tree.map(lambda values: jnp.asarray(np.asarray(values)[chosen]), kept)._replace(
        **shared
    )


def with_target(
    study: Study, target: Float[np.ndarray, "height width 3"], *, limit: float = np.inf
) -> Study:
    """Return the study with an image as its goal.

    Args:
        study: A view.
        target: Linear RGB, of the view's size.
        limit: Where the target's format saturates: 1 for PNG.

    Raises:
        ValueError: If the sizes differ, or a pixel is not finite.
    """
    if target.shape[:2] != study.facing.shape:
        raise ValueError(
            f"target image: expected height x width {study.facing.shape} as the view, "
            f"got {target.shape[:2]}; set the image size or scale the target"
        )
    if not np.isfinite(target).all():
        raise ValueError("target image: has pixels that are NaN or infinite; repair the image")
    unlit, lit = (study.picture(np.full(study.facing.shape, v, np.float32)) for v in (0.0, 1.0))
    goal = ImageGoal(
        unlit=jnp.asarray(unlit[study.facing]),
        direct=jnp.asarray((lit - unlit)[study.facing]),
        target=jnp.asarray(target[study.facing]),
        limit=jnp.asarray(limit, jnp.float32),
    )
    return study._replace(trial=study.trial._replace(goal=goal))
