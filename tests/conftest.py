"""Settings and fixtures that all tests share."""

import os
from pathlib import Path

# Compiled functions are kept between runs, also for the programs that tests start; read on
# import. It halves the time of a second run; `make clean` empties it.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".jax_cache"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")

import hypothesis
import jax
import jaxtyping
import numpy as np
import pytest

jax.config.update("jax_enable_x64", True)

# No deadline: the first call of each shape compiles.
hypothesis.settings.register_profile("tests", deadline=None, derandomize=True)
hypothesis.settings.load_profile("tests")


# Files of minutes come first, so that no process is alone with one in the end.
_LONG = ("test_notebooks", "test_failure_scenes", "test_soft_truth", "test_frontier")


def pytest_collection_modifyitems(items):
    """Order the tests by file, long ones first."""
    place = {name: k for k, name in enumerate(_LONG)}
    items.sort(key=lambda item: place.get(item.path.stem, len(_LONG)))


@pytest.fixture(scope="module", autouse=True)
def _compiled_functions_end_with_their_module():
    """Free what a module compiled: some thousand programs exceed what a process may map."""
    yield
    jax.clear_caches()


@pytest.fixture(scope="session", autouse=True)
def _memory_goes_back_to_the_system():
    """Commands keep what they free, to be sooner; a process of many commands would grow."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("experiments.memory.keep_freed_memory", lambda: False)
        yield


@pytest.fixture(params=[np.float32, np.float64], ids=["float32", "float64"])
def dtype(request):
    """Run the test in single precision, where users live, and in double."""
    return request.param


@pytest.fixture(autouse=True)
def _as_users_run_it(request):
    """Switch the type hook off in tests marked ``errors``: users see the code's own errors."""
    if request.node.get_closest_marker("errors") is None:
        yield
        return
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", before)
