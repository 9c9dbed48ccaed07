"""What a search chose, in the words of ``render`` and as what ``render_scene`` takes."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from shadows.layouts import Layout
from shadows.render import Rendering

from ..rendering.prepare_scene import prepare_scene
from ..rendering.render_scene import render_scene
from ..scene import Scene
from ..technique_words import parse_bias, parse_lookup
from .models import Model, bias_words, filters
from .sight import SHADING, Sight, with_look

# Without shadows in the words of ``render``, which always draws a map: nothing blocks where
# every point counts as at the light.
_SMALLEST = 16


class Choice(NamedTuple):
    """A model, ready to render; ``render_scene(choice.scene(scene), **choice.techniques)``.

    Attributes:
        look: ``plain`` where normal maps are left out.
        map_size: Texels on each side.
        filter: Words of ``--filter``.
        bias: Words of ``--bias``.
        layout: How many maps serve each light; the least that does, as ``render`` chooses it.
    """

    look: str
    map_size: int
    filter: tuple[str, ...]
    bias: tuple[str, ...]
    layout: Layout

    @property
    def techniques(self) -> dict[str, Any]:
        """What ``render_scene`` takes beside the scene and the size of the image."""
        filter, compare = parse_lookup(self.filter, ())
        return {
            "map_size": self.map_size,
            "filter": filter,
            "compare": compare,
            "bias": parse_bias(self.bias, filter),
            "layout": self.layout,
            "shading": SHADING,
        }

    def scene(self, scene: Scene) -> Scene:
        """Return a scene ready to render, without what the choice leaves out."""
        return with_look(prepare_scene(scene), self.look)

    def render(self, scene: Scene, image_size: int) -> Rendering:
        """Render a scene."""
        size = (image_size, image_size)
        return render_scene(self.scene(scene), image_size=size, **self.techniques)

    def arguments(self, flat_map: str | None = None) -> list[str]:
        """Return the options with which the command ``render`` shows the same.

        Args:
            flat_map: File of a flat normal map, where the choice leaves the scene's own out.
        """
        words = ["--shadow-map-size", str(self.map_size), "--filter", *self.filter]
        words += ["--bias", *self.bias]
        return [*words, "--normal-map", flat_map] if flat_map else words


def choose(model: Model, sight: Sight, slope: float) -> Choice:
    """Return a model as a choice for a scene.

    Args:
        model: The model.
        sight: The scene.
        slope: Of the constant bias, see ``bias_words``.
    """
    if not model.filter:
        beyond = f"constant={10 * np.ceil(_extent(sight)):g}"
        return Choice(model.look, _SMALLEST, ("nearest",), (beyond,), sight.layout)
    words: Sequence[str] = filters()[model.filter].words
    bias = bias_words(model.bias, slope)
    return Choice(model.look, model.map_size, tuple(words), bias, sight.layout)


def _extent(sight: Sight) -> float:
    """Return the greatest length that a shadow ray may have."""
    points = [np.asarray(sight.scene.mesh.positions)]
    sources = [getattr(seen.light, "position", None) for seen in sight.seen]
    points += [np.asarray(source)[None] for source in sources if source is not None]
    return float(np.linalg.norm(np.ptp(np.concatenate(points), axis=0)))
