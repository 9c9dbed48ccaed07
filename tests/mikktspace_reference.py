"""MikkTSpace written from its description, one corner at a time: the oracle of its tests."""

import math

import numpy as np


def slow_corner_tangents(positions, normals, uvs, faces, real=np.float32):
    """Return tangent and sign per corner, all arithmetic in the type ``real``."""
    with np.errstate(all="ignore"):
        return _Slow(positions, normals, uvs, faces, real).tangents()


def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _nonzero(x):
    return abs(x) > np.finfo(np.float32).tiny


def _normalized(v):
    if not any(_nonzero(x) for x in v):
        return v
    return v.dtype.type(1) / np.sqrt(_dot(v, v)) * v


def _projected(v, n):
    return _normalized(v - _dot(n, v) * n)


class _Slow:
    def __init__(self, positions, normals, uvs, faces, real):
        self.real, self.faces = real, faces
        self.p, self.n, self.uv = (
            [array[v].astype(real) for face in faces for v in face]
            for array in (positions, normals, uvs)
        )

    def tangents(self):
        result = np.tile(np.array([1, 0, 0, -1], self.real), (len(self.p), 1))
        self.name = slow_names(self.p, self.n, self.uv)
        keys = range(len(self.faces))
        equal = lambda a, b: bool((self.p[a] == self.p[b]).all())
        self.good = [
            f for f in keys if not any(equal(3 * f + i, 3 * f + (i + 1) % 3) for i in range(3))
        ]
        self.derive()
        self.beyond = slow_partners(self.name, self.good)
        for members, sign in self.grow():
            for corner in members:
                result[corner, :3], result[corner, 3] = self.sum(corner, members), sign
        for f in sorted(set(keys) - set(self.good)):
            for c in range(3 * f, 3 * f + 3):
                same = [d for g in self.good for d in range(3 * g, 3 * g + 3)]
                same = [d for d in same if self.name[d] == self.name[c]]
                if same:
                    result[c] = result[same[0]]
        return result.reshape(-1, 3, 4)

    def derive(self):
        """Tangent, bitangent and handedness per face; handedness 0 for loose faces."""
        self.along_u, self.along_v, self.hand = {}, {}, {}
        for f in self.good:
            d1, d2 = (self.p[3 * f + i] - self.p[3 * f] for i in (1, 2))
            (u1, v1), (u2, v2) = (self.uv[3 * f + i] - self.uv[3 * f] for i in (1, 2))
            area = u1 * v2 - v1 * u2
            sign = 1 if area > 0 else -1
            s, t = v2 * d1 - v1 * d2, -u2 * d1 + u1 * d2
            lengths = [np.sqrt(_dot(v, v)) for v in (s, t)]
            units = [
                self.real(sign) / length * v
                if _nonzero(area) and _nonzero(length)
                else np.zeros(3, self.real)
                for v, length in zip((s, t), lengths, strict=True)
            ]
            self.along_u[f], self.along_v[f] = units
            firm = _nonzero(area) and all(_nonzero(length / abs(area)) for length in lengths)
            self.hand[f] = sign if firm else 0

    def around(self, corner):
        """Return the corners next to this one around its vertex, across either edge."""
        f, i = divmod(corner, 3)
        ahead = self.beyond.get(corner)
        behind = self.beyond.get(3 * f + (i - 1) % 3)
        neighbors = [] if behind is None else [behind]
        if ahead is not None:
            neighbors.append(3 * (ahead // 3) + (ahead % 3 + 1) % 3)
        return neighbors

    def grow(self):
        """Yield the groups: their corners in ascending order, and their handedness."""
        hand, taken, groups = dict(self.hand), set(), []
        for seed in (3 * f + i for f in self.good for i in range(3)):
            if seed in taken or self.hand[seed // 3] == 0:
                continue
            sign, members, open_ends = hand[seed // 3], {seed}, [seed]
            while open_ends:
                for c in self.around(open_ends.pop()):
                    if c in members or c in taken:
                        continue
                    hand[c // 3] = hand[c // 3] or sign
                    if hand[c // 3] == sign:
                        members.add(c)
                        open_ends.append(c)
            taken |= members
            groups.append((sorted(members), sign))
        return groups

    def sum(self, corner, members):
        """Sum the group's tangents for one corner, less those opposite to its own."""
        n, own = self.n[corner], corner // 3
        total = np.zeros(3, self.real)
        for c in members:
            f = c // 3
            if self.hand[f] == 0:
                continue
            s, t = _projected(self.along_u[f], n), _projected(self.along_v[f], n)
            if self.hand[own] != 0 and own != f:
                apart_s = _dot(_projected(self.along_u[own], n), s) > -1
                apart_t = _dot(_projected(self.along_v[own], n), t) > -1
                if not (apart_s and apart_t):
                    continue
            before, after = (self.p[3 * f + (c + k) % 3] - self.p[c] for k in (2, 1))
            cosine = _dot(_projected(before, n), _projected(after, n))
            cosine = min(max(float(cosine), -1.0), 1.0)
            total = total + self.real(math.acos(cosine)) * s
        return _normalized(total)


def slow_names(p, n, uv):
    """Name each corner by the first, in sorting order, that equals it."""
    names = list(range(len(p)))
    if len(p) == 0:
        return names
    points = np.array(p)
    low, high = points.min(axis=0), points.max(axis=0)
    axis = _longest(high - low)
    cells = {}
    for c, point in enumerate(points):
        share = points.dtype.type(2048) * ((point[axis] - low[axis]) / (high[axis] - low[axis]))
        cell = 0 if math.isnan(share) else min(int(share), 2047)
        cells.setdefault(cell, []).append(c)

    def weld(corners):
        inside = points[corners]
        low, high = inside.min(axis=0), inside.max(axis=0)
        axis = _longest(high - low)
        middle = points.dtype.type(0.5) * (high[axis] + low[axis])
        if low[axis] < middle < high[axis]:
            for half in _halves(corners, lambda c: points[c, axis] < middle):
                weld(half)
            return
        for place, c in enumerate(corners):
            for d in corners[:place]:
                if all(np.all(array[c] == array[d]) for array in (p, n, uv)):
                    names[c] = names[d]
                    break

    for corners in cells.values():
        weld(corners)
    return names


def _longest(sides):
    if sides[1] > sides[0] and sides[1] > sides[2]:
        return 1
    return 2 if sides[2] > sides[0] else 0


def _halves(items, lower):
    """Partition in place: two pointers walk inwards and exchange what is on the wrong side."""
    i, j = 0, len(items) - 1
    while True:
        while i < j and lower(items[i]):
            i += 1
        while i < j and not lower(items[j]):
            j -= 1
        if i >= j:
            break
        items[i], items[j] = items[j], items[i]
    split = sum(lower(item) for item in items)
    return items[:split], items[split:]


def slow_partners(names, faces):
    """Find the partner of each edge, as a dictionary; edges have their first corner's number."""
    edges = []
    for f in faces:
        for i in range(3):
            a, b = names[3 * f + i], names[3 * f + (i + 1) % 3]
            edges.append((min(a, b), max(a, b), 3 * f + i, a < b))
    most = max((edge[0] for edge in edges), default=None)
    arranged = list(edges)
    _quicksort([edge[0] for edge in edges], arranged)
    tail = [edge for edge in arranged if edge[0] == most]
    start = 0
    for stop in range(1, len(tail)):  # ranges of equal edges are sorted, all but the last one
        if tail[stop][1] != tail[start][1]:
            tail[start:stop] = sorted(tail[start:stop])
            start = stop
    ordered = [edge for edge in sorted(edges) if edge[0] != most] + tail
    partner = {}
    for i, (low, high, corner, forward) in enumerate(ordered):
        if corner in partner:
            continue
        for other_low, other_high, other, other_forward in ordered[i + 1 :]:
            if (low, high) != (other_low, other_high):
                break
            if forward != other_forward and other not in partner:
                partner[corner], partner[other] = other, corner
                break
    return partner


def _quicksort(keys, items):
    """Sort by keys in place, unstably, with the reference's pivots."""

    def sort(left, right, seed):
        if right - left < 1:
            return
        if right - left == 1:
            if keys[left] > keys[right]:
                exchange(left, right)
            return
        turn = seed % 32
        seed = (seed + ((seed << turn) % 2**32 | seed >> (32 - turn)) + 3) % 2**32
        pivot = keys[left + seed % (right - left + 1)]
        i, j = left, right
        while i <= j:
            while keys[i] < pivot:
                i += 1
            while keys[j] > pivot:
                j -= 1
            if i <= j:
                exchange(i, j)
                i, j = i + 1, j - 1
        sort(left, j, seed)
        sort(i, right, seed)

    def exchange(i, j):
        keys[i], keys[j] = keys[j], keys[i]
        items[i], items[j] = items[j], items[i]

    sort(0, len(keys) - 1, 39871946)
