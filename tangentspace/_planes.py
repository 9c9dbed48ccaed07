"""Vectors as planes of coordinates: the same functions, several times faster on a CPU.

Images of vectors are arrays (height, width, 3). XLA on a CPU works on rows of three numbers one
number at a time, and moves them through memory for every cosine; with all first coordinates beside
each other, then all second ones, it works on many at once. ``in_planes`` lets a function stay as
it reads: it is traced, and what it does to arrays of short vectors is done to each coordinate.
"""

import contextvars
import functools
import math
import operator
from collections.abc import Callable, Sequence
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal

from ._fusion import compute_once
from ._math import stack_last

_LONGEST = 4  # coordinates of a short vector
_FEWEST = 256  # vectors that are worth it

_Args = ParamSpec("_Args")
_Result = TypeVar("_Result")
_Shape = tuple[int, ...]

_tracing = contextvars.ContextVar("tracing", default=False)


def in_planes(function: Callable[_Args, _Result]) -> Callable[_Args, _Result]:
    """Decorate a function of arrays, or of trees that hold some: the same values, sooner.

    Where its arguments are traced, it is traced once more by itself; derivatives, ``vmap`` and
    ``jit`` go through. Called within another such function, or without ``jit``, it is as it was.
    """

    @functools.wraps(function)
    def planar(*args: _Args.args, **kwargs: _Args.kwargs) -> _Result:
        arrays, rest = eqx.partition((args, kwargs), _is_array)
        given, tree = jax.tree.flatten(arrays)
        if _tracing.get() or not any(isinstance(array, Tracer) for array in given):
            return function(*args, **kwargs)
        call: Callable[..., Any] = function
        result_rest = result_tree = None

        def rows(*given: Any) -> list:
            nonlocal result_rest, result_tree
            args, kwargs = eqx.combine(jax.tree.unflatten(tree, given), rest)
            result, result_rest = eqx.partition(call(*args, **kwargs), _is_array)
            results, result_tree = jax.tree.flatten(result)
            return results

        token = _tracing.set(True)
        try:
            traced = jax.make_jaxpr(rows)(*given)
            planes = lambda *given: [_whole(value) for value in _evaluate(traced, given)]
            results = compute_once(jax.make_jaxpr(planes)(*given), given)
        finally:
            _tracing.reset(token)
        return eqx.combine(jax.tree.unflatten(result_tree, results), result_rest)

    return planar


def _is_array(value: Any) -> bool:
    return isinstance(value, jax.Array)


class _Vectors:
    """An array of short vectors, as a whole, as planes or as both.

    A plane may be a scalar, if it is the same all over.
    """

    def __init__(self, shape: _Shape, *, whole: Any = None, planes: list | None = None) -> None:
        self.shape, self._whole, self._planes = shape, whole, planes

    @property
    def planes(self) -> list:
        """One for each coordinate."""
        if self._planes is None:
            columns = (functools.partial(_column, self._whole, k) for k in range(self.shape[-1]))
            self._planes = [_known(column, self._whole) for column in columns]
        return self._planes

    @property
    def full(self) -> list:
        """Planes, none of them a scalar."""
        return [_full(plane, self.shape[:-1]) for plane in self.planes]

    @property
    def whole(self) -> Any:
        """The array."""
        if self._whole is None:
            self._whole = stack_last(*self.full)
        return self._whole


def _column(array: Any, k: int) -> Any:
    return array[..., k]


def _full(plane: Any, shape: _Shape) -> Any:
    return plane if jnp.ndim(plane) else jnp.broadcast_to(plane, shape)


def _whole(value: Any) -> Any:
    return value.whole if isinstance(value, _Vectors) else value


def _vectors(value: Any) -> _Vectors:
    return value if isinstance(value, _Vectors) else _Vectors(jnp.shape(value), whole=value)


def _is_short(shape: _Shape) -> bool:
    return len(shape) > 1 and 0 < shape[-1] <= _LONGEST and math.prod(shape[:-1]) >= _FEWEST


def _known(compute: Callable[[], Any], *values: Any) -> Any:
    """Compute now what does not depend on what is traced."""
    if any(isinstance(value, Tracer) for value in values):
        return compute()
    with jax.ensure_compile_time_eval():
        return compute()


def _evaluate(traced: ClosedJaxpr, given: Sequence) -> list:
    """Return the results of a traced function, each an array or ``_Vectors``."""
    values: dict = dict(zip(traced.jaxpr.constvars, traced.consts, strict=True))
    values.update(zip(traced.jaxpr.invars, given, strict=True))

    def read(atom: Any) -> Any:
        if isinstance(atom, Literal):
            return atom.val
        if _is_short(atom.aval.shape):
            values[atom] = _vectors(values[atom])
        return values[atom]

    for eqn in traced.jaxpr.eqns:
        results = _apply(eqn, [read(atom) for atom in eqn.invars])
        for variable, result in zip(eqn.outvars, results, strict=True):
            values[variable] = result if _is_short(variable.aval.shape) else _whole(result)
    return [read(atom) for atom in traced.jaxpr.outvars]


def _apply(eqn: JaxprEqn, inputs: list) -> Sequence:
    """Return the results of one operation."""
    name, first = eqn.primitive.name, next(iter(eqn.outvars), None)
    shape = getattr(getattr(first, "aval", None), "shape", ())
    if name in ("jit", "pjit", "closed_call"):
        return _evaluate(eqn.params["jaxpr"], inputs)
    if any(isinstance(value, _Vectors) for value in inputs) or _is_short(shape):
        rule = _on_each if name in _ELEMENTWISE else _RULES.get(name)
        result = None if rule is None else rule(eqn, inputs, shape)
        if result is not None:
            return [result]
    inputs, params = [_whole(value) for value in inputs], eqn.primitive.get_bind_params(eqn.params)
    bind = functools.partial(eqn.primitive.bind, *inputs, **params)
    # Which coordinate a mask of three means, for one, must be known now.
    now = math.prod(shape) <= _LONGEST and not eqn.effects
    results = _known(bind, *inputs) if now else bind()
    return results if eqn.primitive.multiple_results else [results]


# Each rule returns the result of one operation, or None where it does not know it in planes.


def _on_each(eqn: JaxprEqn, inputs: list, shape: _Shape) -> _Vectors | None:
    if not _is_short(shape):
        return None
    name = eqn.primitive.name
    scalars = {"select_n": (0,), "clamp": (0, 2)}.get(name, ())  # where they may be beside planes

    def apply(*parts: Any) -> Any:
        if name == "select_n" and not isinstance(parts[0], Tracer) and not jnp.ndim(parts[0]):
            return parts[1 + int(parts[0])]
        if any(map(jnp.ndim, parts)):
            fit = lambda k, part: part if k in scalars else _full(part, shape[:-1])
            parts = tuple(fit(k, part) for k, part in enumerate(parts))
        return eqn.primitive.bind(*parts, **eqn.params)

    has_planes = lambda value: isinstance(value, _Vectors) or jnp.ndim(value)
    planes = [_vectors(value).planes if has_planes(value) else [value] for value in inputs]
    planes = [some * (shape[-1] // len(some)) for some in planes]
    return _Vectors(shape, planes=[apply(*parts) for parts in zip(*planes, strict=True)])


def _broadcast(eqn: JaxprEqn, inputs: list, shape: _Shape) -> _Vectors | None:
    if not _is_short(shape):
        return None
    dims = eqn.params["broadcast_dimensions"]
    if dims and dims[-1] == len(shape) - 1:
        parts, dims = _vectors(inputs[0]).planes, dims[:-1]
    else:
        parts = [_whole(inputs[0])]
    grow = lambda part: lax.broadcast_in_dim(part, shape[:-1], dims) if jnp.ndim(part) else part
    return _Vectors(shape, planes=[grow(part) for part in parts] * (shape[-1] // len(parts)))


def _slice(eqn: JaxprEqn, inputs: list, shape: _Shape) -> _Vectors:
    starts, limits = eqn.params["start_indices"], eqn.params["limit_indices"]
    steps = eqn.params["strides"] or (1,) * len(starts)
    planes = _vectors(inputs[0]).planes[starts[-1] : limits[-1] : steps[-1]]
    cut = lambda plane: lax.slice(plane, starts[:-1], limits[:-1], steps[:-1])
    return _Vectors(shape, planes=[cut(p) if jnp.ndim(p) else p for p in planes])


def _squeeze(eqn: JaxprEqn, inputs: list, shape: _Shape) -> Any:
    vectors, dims = _vectors(inputs[0]), eqn.params["dimensions"]
    last = len(vectors.shape) - 1
    planes = [lax.squeeze(plane, [dim for dim in dims if dim != last]) for plane in vectors.full]
    return planes[0] if last in dims else _Vectors(shape, planes=planes)


def _reshape(eqn: JaxprEqn, inputs: list, shape: _Shape) -> Any:
    value = inputs[0]
    if isinstance(value, _Vectors) and value.shape[-1] == 1:
        return value.full[0].reshape(shape)
    if not isinstance(value, _Vectors) and shape[-1] == 1:
        return _Vectors(shape, planes=[value.reshape(shape[:-1])])
    if not isinstance(value, _Vectors) or shape[-1:] != value.shape[-1:]:
        return None
    return _Vectors(shape, planes=[plane.reshape(shape[:-1]) for plane in value.full])


def _gather(eqn: JaxprEqn, inputs: list, shape: _Shape) -> _Vectors | None:
    """Rows of a table."""
    table, indices = inputs
    how, sizes = eqn.params["dimension_numbers"], eqn.params["slice_sizes"]
    rows = how.offset_dims == (len(shape) - 1,) and how.collapsed_slice_dims == (0,)
    if not isinstance(table, _Vectors) or not rows or sizes != (1, table.shape[-1]):
        return None
    how = how._replace(offset_dims=())
    params = {**eqn.params, "dimension_numbers": how, "slice_sizes": (1,)}
    indices = _whole(indices)
    return _Vectors(shape, planes=[eqn.primitive.bind(p, indices, **params) for p in table.full])


def _concatenate(eqn: JaxprEqn, inputs: list, shape: _Shape) -> _Vectors | None:
    if not _is_short(shape):
        return None
    dim, parts = eqn.params["dimension"], [_vectors(value) for value in inputs]
    if dim == len(shape) - 1:
        return _Vectors(shape, planes=[plane for part in parts for plane in part.full])
    columns = zip(*(part.full for part in parts), strict=True)
    return _Vectors(shape, planes=[lax.concatenate(column, dim) for column in columns])


def _stack(eqn: JaxprEqn, inputs: list, shape: _Shape) -> _Vectors | None:
    if not _is_short(shape) or eqn.params["axis"] != len(shape) - 1:
        return None
    return _Vectors(shape, planes=[_whole(value) for value in inputs])


def _transpose(eqn: JaxprEqn, inputs: list, shape: _Shape) -> Any:
    value, order = inputs[0], eqn.params["permutation"]
    if order[-1] == len(shape) - 1:
        return _Vectors(shape, planes=[lax.transpose(p, order[:-1]) for p in _vectors(value).full])
    if order != (1, 0):
        return None
    if isinstance(value, _Vectors):
        return jnp.stack(value.full)
    return _Vectors(shape, planes=[value[k] for k in range(shape[-1])])


def _reduce(eqn: JaxprEqn, inputs: list, shape: _Shape) -> Any:
    if not isinstance(inputs[0], _Vectors):
        return None
    planes, last = inputs[0].full, len(inputs[0].shape) - 1
    axes = tuple(axis for axis in eqn.params["axes"] if axis != last)
    if last in eqn.params["axes"]:
        planes = [functools.reduce(_REDUCTIONS[eqn.primitive.name], planes)]
    if axes:
        planes = [eqn.primitive.bind(plane, **{**eqn.params, "axes": axes}) for plane in planes]
    return planes[0] if last in eqn.params["axes"] else _Vectors(shape, planes=planes)


_REDUCTIONS = {
    "reduce_sum": operator.add,
    "reduce_prod": operator.mul,
    "reduce_max": lax.max,
    "reduce_min": lax.min,
    "reduce_and": operator.and_,
    "reduce_or": operator.or_,
}
_RULES: dict[str, Callable] = {
    "broadcast_in_dim": _broadcast,
    "slice": _slice,
    "squeeze": _squeeze,
    "reshape": _reshape,
    "gather": _gather,
    "concatenate": _concatenate,
    "stack": _stack,
    "transpose": _transpose,
    **dict.fromkeys(_REDUCTIONS, _reduce),
}
# fmt: off
_ELEMENTWISE = frozenset({
    "abs", "add", "and", "atan2", "cbrt", "ceil", "clamp", "convert_element_type", "copy", "cos",
    "cosh", "div", "eq", "exp", "exp2", "expm1", "floor", "ge", "gt", "integer_pow", "is_finite",
    "le", "log", "log1p", "logistic", "lt", "max", "min", "mul", "ne", "neg", "not", "or", "pow",
    "rem", "round", "rsqrt", "select_n", "sign", "sin", "sinh", "sqrt", "square", "stop_gradient",
    "sub", "tan", "tanh", "xor",
})
# fmt: on
