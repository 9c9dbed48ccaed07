"""Renderers that others wrote, on the same chart: Embree, Mitsuba 3 and OpenGL.

They are asked for the light's visibility at our own surface points, and their answers are
shaded by ours: so only the shadow differs. One that cannot run here is named with its reason.
A new peer is a new subclass of ``Peer`` in a module of its own, listed below.
"""

from ..methods import MAP_SIZES
from .embree import Embree
from .mitsuba_rays import Mitsuba
from .opengl import OpenGL
from .peer import Peer as Peer

PEERS: tuple[Peer, ...] = (
    *(Embree(samples) for samples in (1, 4, 16)),
    *(Mitsuba(samples) for samples in (1, 4, 16, 64)),
    *(OpenGL(map_size) for map_size in MAP_SIZES if map_size != 512),
)


def absent() -> dict[str, str]:
    """Return the techniques that cannot run here, each with the reason and what helps."""
    kinds = dict.fromkeys(type(peer) for peer in PEERS)
    reasons = {kind.technique: kind.absent() for kind in kinds}
    return {technique: reason for technique, reason in reasons.items() if reason is not None}
