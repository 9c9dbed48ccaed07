"""Corners that share one tangent, by MikkTSpace's rules of grouping.

Around a vertex, corners of neighboring faces are one group if their faces are mapped with
equal handedness. A *loose* face, whose edges or UVs give no derivative, takes the handedness
of the first group that reaches any of its corners; groups grow in the order of their first
corners. A corner takes the sum over its group, less the faces whose tangent or bitangent is
exactly opposite to its own.

Corners are numbered ``3 * face + corner``; vectors are stored by component, ``(3, corners)``.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int

from ._mikktspace_arithmetic import dot

Corners = Int[np.ndarray, " corners"]
PAIRS_AT_A_TIME = 1 << 20


class Sums(NamedTuple):
    """Which corners are summed for which.

    Attributes:
        corners: Corners that contribute, for each sum in ascending order.
        sums: The sum that each goes into.
        read: The sum that each corner of the mesh takes; -1 for corners in no group.
    """

    corners: Int[np.ndarray, " members"]
    sums: Int[np.ndarray, " members"]
    read: Corners


def group_corners(
    following: Corners, handedness: Int[np.ndarray, " faces"]
) -> tuple[Corners, Int[np.ndarray, " faces"]]:
    """Number the groups, and settle the handedness of loose faces.

    Args:
        following: The next corner around the vertex of each, -1 where there is none.
        handedness: +1 or -1; 0 for loose faces.

    Returns:
        The group of each corner, -1 for corners of loose faces that no group reaches; and
        the handedness, 0 where no group reaches the face.
    """
    firm = np.repeat(handedness != 0, 3)
    if not firm.all():
        handedness = _settled(following, handedness)
    hand = np.repeat(handedness, 3)
    first = _first_of_chain(following, (hand != 0) & (hand == hand[following]))
    is_group = np.zeros(len(first), bool)
    is_group[first[firm]] = True
    return np.where(is_group[first], np.cumsum(is_group)[first] - 1, -1), handedness


def _first_of_chain(following: Corners, linked: Bool[np.ndarray, " corners"]) -> Corners:
    """Return the smallest corner that each is chained to by the links that are kept.

    Pointers jump twice as far each round, forwards and backwards; chains may be closed.
    """
    everyone = np.arange(len(following))
    linked = linked & (following >= 0)
    smallest = everyone
    for start, stop in ((everyone, following), (following, everyone)):
        jump = everyone.copy()
        jump[start[linked]] = stop[linked]
        reach = everyone
        while np.any((further := np.minimum(reach, reach[jump])) != reach):
            reach, jump = further, jump[jump]
        smallest = np.minimum(smallest, reach)
    return smallest


def _settled(
    following: Corners, handedness: Int[np.ndarray, " faces"]
) -> Int[np.ndarray, " faces"]:
    """Return the handedness with that of loose faces filled in.

    Groups can reach a loose face from the ends of the runs of loose corners that its own are
    in. Where all of them are of one handedness, their order does not matter.
    """
    loose, hand = np.repeat(handedness == 0, 3), np.repeat(handedness, 3)
    runs = _first_of_chain(following, loose & loose[following])
    met = np.zeros((2, len(loose)), bool)  # if a run borders on a negative, a positive group
    one = np.flatnonzero((following >= 0) & (loose != loose[following]))
    other = following[one]
    one, other = np.where(loose[one], one, other), np.where(loose[one], other, one)
    met[(hand[other] > 0).astype(int), runs[one]] = True
    negative, positive = np.any(met[:, runs].reshape(2, -1, 3), axis=2)
    settled = handedness + positive - negative
    if np.any(contested := negative & positive):
        settled = _settled_in_order(following, handedness, settled, contested)
    return settled


def _settled_in_order(
    following: Corners,
    handedness: Int[np.ndarray, " faces"],
    settled: Int[np.ndarray, " faces"],
    contested: Bool[np.ndarray, " faces"],
) -> Int[np.ndarray, " faces"]:
    """Let the groups around contested faces grow one after the other, as the reference does.

    The one loop over corners: only those around the vertices of contested faces. All loose
    faces that are met there without a handedness are contested.
    """
    chains = _first_of_chain(following, following >= 0)
    affected = np.zeros(len(chains), bool)
    affected[chains[np.repeat(contested, 3)]] = True
    seeds = np.flatnonzero(affected[chains] & np.repeat(handedness != 0, 3)).tolist()
    previous = np.full(len(following), -1)
    previous[following[following >= 0]] = np.flatnonzero(following >= 0)
    ways, hand, taken = (following.tolist(), previous.tolist()), settled.tolist(), set()
    for seed in seeds:
        if seed in taken:
            continue
        taken.add(seed)
        for way in ways:
            corner = way[seed]
            while corner >= 0 and corner not in taken:
                hand[corner // 3] = hand[corner // 3] or hand[seed // 3]
                if hand[corner // 3] != hand[seed // 3]:
                    break
                taken.add(corner)
                corner = way[corner]
    return np.array(hand)


def sums_without_opposites(
    groups: Corners,
    firm: Bool[np.ndarray, " corners"],
    tangents: Float32[np.ndarray, "3 corners"],
    bitangents: Float32[np.ndarray, "3 corners"],
) -> Sums:
    """List the sums: one per group, and one per corner that leaves faces of its group out.

    Args:
        groups: The group of each corner.
        firm: If the corner's face is not loose; only then it contributes or leaves out.
        tangents: Unit tangent of each corner's face in the plane of the corner's normal.
        bitangents: The same of the bitangent.
    """
    members = np.flatnonzero(firm)
    crowd = members[_doubtful(groups[members], tangents[:, members], bitangents[:, members])]
    crowd = crowd[np.argsort(groups[crowd], kind="stable")]
    owner, member = _own_lists(groups[crowd], tangents[:, crowd], bitangents[:, crowd])
    owners, own = np.unique(owner, return_inverse=True)
    count, read = groups.max(initial=-1) + 1, groups.copy()
    read[crowd[owners]] = count + np.arange(len(owners))
    return Sums(
        np.concatenate([members, crowd[member]]),
        np.concatenate([groups[members], count + own]),
        read,
    )


def _doubtful(
    groups: Int[np.ndarray, " members"],
    tangents: Float32[np.ndarray, "3 members"],
    bitangents: Float32[np.ndarray, "3 members"],
) -> Bool[np.ndarray, " members"]:
    """Find the members of groups that may hold opposites: not all within a narrower cone.

    Two directions whose cosines with the group's first member are above 0.1 differ by less
    than 170 degrees; rounding makes no opposites of them.
    """
    first = np.zeros(groups.max(initial=-1) + 1, np.int64)
    first[groups[::-1]] = np.arange(len(groups))[::-1]  # the last assignment counts
    near = (dot(tangents, tangents[:, first[groups]]) > 0.1) & (
        dot(bitangents, bitangents[:, first[groups]]) > 0.1
    )
    doubtful = np.zeros(len(first), bool)
    doubtful[groups[~near]] = True
    return doubtful[groups]


def _own_lists(
    groups: Int[np.ndarray, " members"],
    tangents: Float32[np.ndarray, "3 members"],
    bitangents: Float32[np.ndarray, "3 members"],
) -> tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"]]:
    """Compare all pairs within the groups, which are ranges; list what is left for whom.

    Returns:
        Pairs (owner, member), for the owners only that leave out some member.
    """
    _, group, counts = np.unique(groups, return_inverse=True, return_counts=True)
    starts, sizes = (np.cumsum(counts) - counts)[group], counts[group]
    owners, members = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    blocks = np.cumsum(sizes) // PAIRS_AT_A_TIME
    for block in np.split(np.arange(len(groups)), np.flatnonzero(np.diff(blocks)) + 1):
        size = sizes[block]
        offsets = np.cumsum(size) - size
        owner = np.repeat(block, size)
        member = np.arange(len(owner)) + np.repeat(starts[block] - offsets, size)
        kept = dot(tangents[:, owner], tangents[:, member]) > -1
        kept &= dot(bitangents[:, owner], bitangents[:, member]) > -1
        kept |= owner == member
        leaves_out = np.bincount(owner[~kept], minlength=len(groups)) > 0
        kept &= leaves_out[owner]
        owners.append(owner[kept])
        members.append(member[kept])
    return np.concatenate(owners), np.concatenate(members)
