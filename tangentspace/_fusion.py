"""Where XLA should stop fusing on a CPU.

It computes again, for each of its users, what it thinks is cheap: sums, products and choices. A
long chain of them with many users at its end, and a derivative is such a chain for each of a
function's values, may be computed dozens of times. What ends in a division is computed once; so
where a chain has grown long, its end is divided by a one that XLA does not know to be one, as it
comes from behind a barrier. (The barrier by itself is gone before anything is fused.)
"""

import math
from collections import Counter
from collections.abc import Sequence

import jax.numpy as jnp
from jax import Array, lax
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal, Var

_LONG = 8  # operations that are not worth to be done twice
_FEW = 4096  # numbers that are soon computed
_GATHER = 6  # operations that one gather is worth
# fmt: off
_FREE = frozenset({
    "and", "broadcast_in_dim", "convert_element_type", "copy", "eq", "ge", "gt", "is_finite", "le",
    "lt", "ne", "neg", "not", "or", "reshape", "slice", "squeeze", "stop_gradient",
})
_ONCE = frozenset({
    "atan2", "custom_jvp_call", "div", "exp", "log", "pow", "rsqrt", "sin", "cos", "sqrt", "tan",
    "tanh",
})
# fmt: on


def once(values: Array) -> Array:
    """Return the same values, computed once for all who use them."""
    one = lax.optimization_barrier(jnp.ones((), values.dtype))
    return lax.div(values, jnp.broadcast_to(one, values.shape))


def compute_once(traced: ClosedJaxpr, given: Sequence) -> Sequence:
    """Return the results of a traced function; long chains in it are computed once.

    Derivatives of the result are, too: what is divided forward is divided backward.
    """
    # One barrier for all: as many as there are ends let XLA fuse less, and take half as long again.
    jaxpr, one = traced.jaxpr, lax.optimization_barrier(jnp.ones(()))
    values: dict = dict(zip(jaxpr.constvars, traced.consts, strict=True))
    values.update(zip(jaxpr.invars, given, strict=True))
    read = lambda atom: atom.val if isinstance(atom, Literal) else values[atom]
    ends = _ends_of_chains(jaxpr.eqns, jaxpr.outvars)
    for eqn in jaxpr.eqns:
        params = eqn.primitive.get_bind_params(eqn.params)
        results = eqn.primitive.bind(*map(read, eqn.invars), **params)
        results = results if eqn.primitive.multiple_results else [results]
        for variable, result in zip(eqn.outvars, results, strict=True):
            values[variable] = (
                result / jnp.asarray(one, result.dtype) if variable in ends else result
            )
    return [read(atom) for atom in jaxpr.outvars]


def _ends_of_chains(eqns: Sequence[JaxprEqn], results: Sequence) -> set[Var]:
    """Return the variables to compute once."""
    users: Counter = Counter(_large(results))
    for eqn in eqns:
        for variable in _large(eqn.invars):
            users[variable] += _repeats(eqn)
    ends: set = set()
    lengths: Counter = Counter()
    for eqn in eqns:
        name = eqn.primitive.name
        length = 0 if name in _FREE else _GATHER if name == "gather" else 1
        length += sum(lengths[variable] for variable in _large(eqn.invars))
        for variable in _large(eqn.outvars):
            again = (users[variable] - 1) * length
            if name not in _FREE and name not in _ONCE and again >= _LONG:
                ends.add(variable)
            once = variable in ends or (name in _ONCE and users[variable] > 1)
            lengths[variable] = 0 if once else length
    # Backwards, a chain leads from the results to a value, and goes on to each of its operands.
    lengths.clear()
    for eqn in reversed(eqns):
        operands = _large(eqn.invars)
        for variable in _large(eqn.outvars):
            if eqn.primitive.name not in _FREE and (len(operands) - 1) * lengths[variable] >= _LONG:
                ends.add(variable)
            length = 0 if variable in ends else lengths[variable]
            for operand in operands:
                lengths[operand] += length + (eqn.primitive.name not in _FREE)
    return ends


def _large(atoms: Sequence) -> set[Var]:
    """Return the variables that hold many numbers."""
    is_large = lambda aval: (
        math.prod(aval.shape) >= _FEW and jnp.issubdtype(aval.dtype, jnp.floating)
    )
    return {atom for atom in atoms if not isinstance(atom, Literal) and is_large(atom.aval)}


def _repeats(eqn: JaxprEqn) -> int:
    """Return how often an operation asks for each number of its operand."""
    if eqn.primitive.name != "broadcast_in_dim":
        return 1
    size = lambda atom: math.prod(atom.aval.shape)
    return size(eqn.outvars[0]) // max(size(eqn.invars[0]), 1)
