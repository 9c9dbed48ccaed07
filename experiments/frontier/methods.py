"""What the frontier compares: every filter with its numbers of taps, at every size of map."""

from collections.abc import Sequence

from shadows.filters import Filter

from ..options import hint, techniques
from .shadow_method import Method

# The words of ``--filter`` for filters of several sizes; any other filter counts once.
_SIZES = {
    "pcf": {"pcf 3x3": (), "pcf 5x5": (".radius=2",), "pcf 9x9": (".radius=4",)},
    "tent": {"tent 3x3": (), "tent 5x5": (".radius=2",), "tent 7x7": (".radius=3",)},
    "poisson": {f"poisson {n}": (f".taps={n}",) for n in (8, 16, 32)},
    "pcss": {f"pcss {n}": (f".taps={n}", f".search_taps={n}") for n in (8, 16, 32)},
    "vsm": {f"vsm {2 * r + 1}x{2 * r + 1}": (f".radius={r}",) for r in (1, 2, 4)},
    "msm": {f"msm {2 * r + 1}x{2 * r + 1}": (f".radius={r}",) for r in (1, 2, 4)},
}
MAP_SIZES = (256, 512, 1024, 2048)
QUICK_MAP_SIZES = (256, 1024)
_JUDGED = 1024  # maps at which gradients of the first size of each filter are judged


def methods(names: Sequence[str] = (), *, quick: bool = False) -> tuple[Method, ...]:
    """Return the methods to compare, cheap ones first.

    Args:
        names: Filters; none for all that there are.
        quick: One size of each filter, and two of the map.

    Raises:
        ValueError: If there is no filter of a name.
    """
    known = techniques(Filter)
    for name in names:
        if name not in known:
            raise ValueError(f"--techniques: no such filter '{name}'; {hint(name, known)}")
    found = []
    for map_size in QUICK_MAP_SIZES if quick else MAP_SIZES:
        for name in names or known:
            sizes = _SIZES.get(name, {name: ()})
            chosen = list(sizes.items())[: 1 if quick else None]
            found += [
                Method(name, label, (name, *more), map_size, (map_size, k) == (_JUDGED, 0))
                for k, (label, more) in enumerate(chosen)
            ]
    return tuple(found)
