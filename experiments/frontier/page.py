"""The page: error against time of all methods, to point at and to see; one file, no network."""

import base64
import json
import math
import re
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

from ..figures import ACNE_COLOR, LEAK_COLOR
from ..files.images import atomic_path
from .chart import COLORS

_ERRORS = (  # column, its name, what it is, and what in shading
    ("rmse", "RMSE", "RMSE of visibility (0 to 1)", "RMSE of color, linear"),
    ("rmse_penumbra", "RMSE in penumbrae", "RMSE of visibility in true penumbrae (0 to 1)"),
    ("error", "wrong pixels", "share of wrong pixels (0 to 1)"),
    ("error_interior", "wrong pixels away from edges", "share of wrong pixels, away from edges"),
    ("acne", "acne", "acne: share of truth-lit pixels dark"),
    ("leak", "leaks", "leaks: share of truth-dark pixels lit"),
    ("flip", "FLIP", "mean FLIP of the picture (0 to 1)"),
    ("gradient_error", "error of gradients", "error of gradients as the light moves"),
)
_COSTS = (
    ("total_ms", "time of an image", "light pass, preparation and image (ms)", "lighting (ms)"),
    ("gradient_ms_median", "time of a gradient", "loss and its derivative in a bias (ms)",
     "loss and its gradient in texels (ms)"),
    ("kept_bytes", "memory", "memory kept between images"),
)  # fmt: skip


def save_page(
    rows: Sequence[Mapping[str, Any]],
    pictures: Mapping[tuple[str, str], bytes],
    path: Path,
    *,
    made_with: Mapping[str, Any],
) -> None:
    """Write the page, with all that it shows inside.

    Args:
        rows: Of ``frontier``'s table. Those of a scene differ in ``name``, which without that
            column is the setting and the size of the map. What is not finite is not shown.
        pictures: WebP files by scene and name (``pictures.picture``); not all rows need one.
        path: HTML file.
        made_with: ``versions``, ``device`` and ``commit``.
    """
    families = list(dict.fromkeys(map(_family, rows)))
    listed = [
        {key: _finite(value) for key, value in row.items()}
        | {"name": _name(row), "panel": _panel(row), "family": families.index(_family(row))}
        for row in rows
    ]
    data = {
        "rows": listed,
        "errors": _columns(_ERRORS),
        "costs": _columns(_COSTS),
        "families": [
            {"label": label, "hollow": kind == "peer", "color": color, "mark": mark}
            for mark, ((kind, label), color) in enumerate(zip(families, cycle(COLORS)))
        ],
        "pictures": {
            k: base64.b64encode(pictures[row["scene"], row["name"]]).decode()
            for k, row in enumerate(listed)
            if (row["scene"], row["name"]) in pictures
        },
        "made": _made(made_with),
    }
    parts = {
        "style": _file("page.css"),
        "script": _file("page_parts.js") + _file("page.js"),
        "acne": ACNE_COLOR,
        "leak": LEAK_COLOR,
        # Without "<" nothing in the data can end the script that holds it.
        "data": json.dumps(data, allow_nan=False).replace("<", r"\u003c"),
    }
    page = re.sub(r"@(\w+)@", lambda found: parts[found[1]], _file("page.html"))
    with atomic_path(path) as temporary:
        temporary.write_text(page, "utf-8")


def _columns(columns: Sequence[tuple[str, ...]]) -> list[dict[str, str]]:
    return [dict(zip(("column", "name", "axis", "shading"), of, strict=False)) for of in columns]


def _family(row: Mapping[str, Any]) -> tuple[str, str]:
    """Return kind and technique, which share a color and a mark."""
    return row.get("kind") or "shadow", row["technique"]


def _panel(row: Mapping[str, Any]) -> str:
    """Return whose chart a row is on: how a normal map is lit has errors of its own."""
    return row["scene"] + (": its normal map" if row.get("kind") == "shading" else "")


def _name(row: Mapping[str, Any]) -> str:
    return row.get("name") or f"{row['setting']} @ {row['map_size']}"


def _finite(value: Any) -> Any:
    """Return None for numbers that JSON has no word for."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _made(made_with: Mapping[str, Any]) -> str:
    packages = ", ".join(f"{name} {version}" for name, version in made_with["versions"].items())
    commit = made_with["commit"] or "unknown"
    return f"Measured on {made_with['device']}, commit {commit}; {packages}."


def _file(name: str) -> str:
    return Path(__file__).with_name(name).read_text("utf-8")
