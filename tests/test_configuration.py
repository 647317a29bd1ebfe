"""The settings, errors and warnings of `configure`."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest
from jax.experimental.compilation_cache import compilation_cache
from jaxlib import version

import fdof_jax as fj
from fdof_jax.base import configuration

NEEDS_OPTION = version.__version_info__ < (0, 12)

# Imports what a user may import first, computes, then configures again, too late.
APPLICATION = """
import collections, json, os, sys, warnings
import jax
import jax.numpy as jnp
import fdof_jax as fj
fj.simulate, fj.tune, fj.fit
fj.configure(x64=True, cache=sys.argv[1])
flags = os.environ["XLA_FLAGS"]
events = collections.Counter()
jax.monitoring.register_event_listener(lambda event, **_: events.update([event]))
q = fj.tip_position(fj.scenes.fig5().linkage, jnp.zeros(3))
loop = jax.jit(lambda x: jax.lax.fori_loop(0, 9, lambda i, y: y * i + x, x))
kernel = "xla_cpu_small_call" in loop.lower(jnp.ones(1000)).compile().as_text()
os.environ["XLA_FLAGS"] = ""
with warnings.catch_warnings(record=True) as late:
    warnings.simplefilter("always")
    fj.configure()
print(json.dumps(dict(
    dtype=str(q.dtype), flags=flags, kernel=kernel,
    hits=events["/jax/compilation_cache/cache_hits"],
    misses=events["/jax/compilation_cache/cache_misses"],
    late=[(str(w.message), w.filename) for w in late],
)))
"""


def run_application(cache, flags):
    command = [sys.executable, "-W", "error", "-c", APPLICATION, cache]
    env = os.environ | {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags}
    done = subprocess.run(command, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_an_application(tmp_path):
    cache, own = tmp_path / "not" / "yet", "--xla_backend_extra_options=xla_unknown=1"
    first = run_application(cache, own)
    assert first["dtype"] == "float64" and first["kernel"]
    # Options add up.
    expected = f"{own} {configuration._FLAG}" if NEEDS_OPTION else own
    assert first["flags"] == expected
    assert len(first["late"]) == NEEDS_OPTION
    for message, file in first["late"]:
        assert "configure: " in message and "JAX had started" in message
        assert file == "<string>"  # the line that calls it
    (folder,) = cache.iterdir()
    assert folder.name == configuration._processor()
    programs = lambda: {p.name for p in folder.iterdir() if "atime" not in p.name}
    kept = programs()
    assert first["misses"] > 0 and kept
    # All of them are found again.
    second = run_application(cache, own)
    assert second["hits"] >= first["misses"] and second["misses"] == 0
    assert programs() == kept


# In this process, whose own settings come back


NAMES = """jax_compilation_cache_dir jax_persistent_cache_min_compile_time_secs
jax_persistent_cache_min_entry_size_bytes jax_enable_x64""".split()


def settings():
    return {name: getattr(jax.config, name) for name in NAMES}


@pytest.fixture(autouse=True)
def restored(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", configuration._FLAG)  # nothing to be warned of
    before = settings()
    yield before
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


def test_precision_alone_is_set(restored):
    fj.configure()
    assert settings() == restored
    for x64 in (False, True):
        fj.configure(x64=x64)
        assert settings() == restored | {"jax_enable_x64": x64}


FOLDERS = "", 1, b"folder", "file/below", "~no-such-user/x", "gs://bucket", "closed"
REFUSED = {
    "x64": ("True or False", [1, "yes", [True]]),
    "cache": ("a folder, True or False", FOLDERS),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refusals_change_nothing(name, restored, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    closed = Path("closed") / configuration._processor()
    closed.mkdir(0o500, parents=True)
    expected, values = REFUSED[name]
    for value in values:
        if value == "closed" and os.access(closed, os.W_OK):  # root may
            continue
        sound = {"x64": False, "cache": tmp_path / "new"}
        words = rf"^{name}: expected {expected}.*, got .*"
        with pytest.raises(ValueError, match=words):
            fj.configure(**(sound | {name: value}))
        assert settings() == restored


CACHES = [
    ("linux", {"XDG_CACHE_HOME": ""}, ".cache"),
    ("linux", {"XDG_CACHE_HOME": "~/other"}, "other"),
    ("darwin", {}, "Library/Caches"),
    ("win32", {"LOCALAPPDATA": ""}, "AppData/Local"),
]


@pytest.mark.parametrize("system, variables, expected", CACHES)
def test_the_users_cache_folder(system, variables, expected, monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "platform", system)
    for name, value in {"HOME": str(tmp_path), **variables}.items():
        monkeypatch.setenv(name, value)
    fj.configure(cache=True)
    expected = tmp_path / expected / "fdof_jax" / configuration._processor()
    assert Path(jax.config.jax_compilation_cache_dir) == expected.resolve()
    assert expected.is_dir()
    fj.configure(cache=False)
    assert jax.config.jax_compilation_cache_dir is None


@pytest.mark.skipif(not NEEDS_OPTION, reason="this version of XLA needs no option")
def test_flags_in_a_file_are_left_alone(monkeypatch):
    monkeypatch.setattr(configuration.xla_bridge, "backends_are_initialized", bool)
    monkeypatch.setenv("XLA_FLAGS", "flags.txt")
    with pytest.warns(UserWarning, match="XLA_FLAGS names a file; add --xla_"):
        fj.configure()
    assert os.environ["XLA_FLAGS"] == "flags.txt"
