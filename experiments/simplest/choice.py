"""What a search chose, in the words of ``render`` and as what ``render_scene`` takes."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from shadows.layouts import Layout
from shadows.render import Rendering

from ..rendering.prepare_scene import prepare_scene
from ..rendering.render_scene import Shadows, render_scene
from ..scene import Scene
from ..technique_words import parse_bias, parse_lookup
from .models import Model, bias_words, filters
from .sight import SHADING, Sight, with_look


class Choice(NamedTuple):
    """A model, ready to render; ``render_scene(choice.scene(scene), **choice.techniques)``.

    Attributes:
        look: ``plain`` where normal maps are left out.
        map_size: Texels on each side; 0 where nothing casts shadows.
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
    def shadows(self) -> Shadows:
        """What casts them."""
        return "maps" if self.map_size else "none"

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
            "shadows": self.shadows,
        }

    def scene(self, scene: Scene) -> Scene:
        """Return a scene ready to render, without what the choice leaves out."""
        return with_look(prepare_scene(scene), self.look)

    def render(self, scene: Scene, image_size: int) -> Rendering:
        """Render a scene."""
        size = (image_size, image_size)
        return render_scene(self.scene(scene), image_size=size, **self.techniques)

    def arguments(self, looks: Sequence[str]) -> list[str]:
        """Return the options with which the command ``render`` shows the same.

        Args:
            looks: Those that the scene has.
        """
        words = ["--shadow-map-size", str(self.map_size), "--filter", *self.filter]
        words += ["--bias", *self.bias]
        if self.shadows == "none":
            words = ["--shadows", "none"]
        return words if self.look == looks[-1] else [*words, "--normal-map", "none"]


def choose(model: Model, sight: Sight, slope: float) -> Choice:
    """Return a model as a choice for a scene.

    Args:
        model: The model.
        sight: The scene.
        slope: Of the constant bias, see ``bias_words``.
    """
    if not model.filter:
        return Choice(model.look, 0, ("nearest",), (), sight.layout)
    words: Sequence[str] = filters()[model.filter].words
    bias = bias_words(model.bias, slope)
    return Choice(model.look, model.map_size, tuple(words), bias, sight.layout)
