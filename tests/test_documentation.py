"""Every public name is documented: purpose, units, source; examples run as doctests."""

import importlib.util
import inspect
import re
from types import SimpleNamespace

import pytest
from test_package import NAMESPACES, ROOT

import fdof_jax as fj
from fdof_jax import drawing, plotting, scenes

_, *ROOMS = NAMESPACES
PUBLIC = {
    f"paper.{name}" if module is fj.paper else name: value
    for module in (fj, *ROOMS, scenes)
    for name in dir(module)
    if callable(value := getattr(module, name))
    and getattr(value, "__module__", "").startswith("fdof_jax")
}
# Names whose arguments or results carry no unit.
UNITLESS = """existence_factors to_mjcf fig3 fig5 fig7 load save stacked circle_scenes
configure Condition Values field accepts_scene called of_kind element_of naming
check_free check_joints check_known check_linkage check_scene function instance
is_traced jit joint_names joints_of moving_joints one_of plain real_array real_state
refusal Report shown whole_number without_fixed""".split()
# Names that implement something printed in the paper.
SOURCES = {
    "(8)-(13)": ["paper.mass_matrix", "mass_matrix"],
    "(14)": ["paper.bias_force", "bias_force", "inverse_dynamics"],
    "(17)-(27)": ["paper.masked_accelerations", "forward_dynamics", "simulate"],
    "(16)-(26)": ["paper.constraint_forces"],
    "(6) and (7)": ["energy", "link_energies"],
    "(4)": ["existence_factors"],
    "Fig": ["Linkage", "JointDamper", "PDController", "CircleTask", "fig3", "fig5"],
}


@pytest.mark.parametrize("name", sorted(PUBLIC))
def test_docstring(name):
    doc = inspect.getdoc(PUBLIC[name]) or ""
    assert len(doc) > 40 and doc.split("\n")[0].strip().endswith("."), doc
    if name not in UNITLESS:
        assert re.search(r"\[[^\]]*(m|rad|N|J|kg|s|degrees)[^\]]*\]", doc), doc
    for source, names in SOURCES.items():
        assert name not in names or source in doc


# Every name that a user may import, with its module unless that is `fdof_jax`.
NAMES = [name for name in fj.__all__ if not inspect.ismodule(getattr(fj, name))]
NAMES += [
    f"{module.__name__.split('.')[-1]}.{name}"
    for module in (*ROOMS, scenes, drawing, plotting)
    for name, value in inspect.getmembers(module, callable)
    if name
    in getattr(module, "__all__", [name] * (value.__module__ == scenes.__name__))
    and getattr(fj, name, None) is not value
]
# Classes of results, and of their parts: the function that returns each.
RETURNED_BY = dict(
    FitResult="fit", Efforts="joint_efforts", Frames="link_frames", End="simulate",
    Events="simulate", Linearization="linearize", MjcfModel="from_mjcf",
    Margins="margins", Modes="closed_loop_modes", NextMotion="next_motion",
    Response="response", Sensitivities="sensitivities", Solution="simulate",
    TuneResult="tune", TunedWithin="tune_within",
)  # fmt: skip


def examples():
    """Returns all code that tests run as examples: doctests and blocks of guides."""
    line, block = r"^ *(?:>>>|\.\.\.) (.*)", r"```python\n([\s\S]*?)```"
    guides = ROOT / "README.md", *(ROOT / "docs").glob("*.md")
    places = [(path, line) for path in (ROOT / "fdof_jax").rglob("*.py")]
    places += [(path, block) for path in guides]
    found = [re.findall(kind, path.read_text(), re.M) for path, kind in places]
    return "\n".join(sum(found, []))


def test_every_name_has_an_example():
    ran = examples()
    for name in NAMES:
        short = name.split(".")[-1]
        maker = RETURNED_BY.get(short, short)
        called = rf"\b(fj(\.[a-z]+)?|scenes|drawing|plotting)\.{maker}\b"
        assert re.search(called, ran), name
        if short in RETURNED_BY:
            returned = inspect.signature(PUBLIC[maker]).return_annotation
            parts = map(str, returned.__annotations__.values())
            assert short in " ".join([returned.__name__, *parts])


def test_every_name_has_a_place_in_the_reference():
    pages = "".join(path.read_text() for path in (ROOT / "docs" / "api").glob("*.md"))
    assert sorted(re.findall(r"^::: fdof_jax\.(\S+)$", pages, re.M)) == sorted(NAMES)


def test_names_in_guides_become_links():
    file = ROOT / "docs" / "name_links.py"
    spec = importlib.util.spec_from_file_location("name_links", file)
    links = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(links)
    guide = SimpleNamespace(file=SimpleNamespace(src_uri="gains.md"))
    for code, name in {
        "tune": "tune",
        "fj.tuning.stacked([scene])": "tuning.stacked",
        "mass_matrix": "mass_matrix",
        "paper.mass_matrix": "paper.mass_matrix",
        "fj.tuning.tune": "tune",
        "Solution.outcome": "Solution",
        "diffrax.PIDController": None,
        "Path(file).write_text(html)": None,
        "store=": None,
    }.items():
        html = f"<p><code>{code}</code></p>"
        link = f'<autoref identifier="fdof_jax.{name}"><code>{code}</code></autoref>'
        found = links.on_page_content(html, guide)
        assert found == (html if name is None else f"<p>{link}</p>")
    linked = '<a href="tuning.html"><code>tune</code></a>'
    assert links.on_page_content(linked, guide) == linked
