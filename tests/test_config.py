"""Settings check themselves; the YAML files agree with them."""

import dataclasses
from itertools import product
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import settings as settings_of_hypothesis
from hypothesis import strategies as st

from reflectsep import config, settings
from reflectsep.cli import help as help_texts
from reflectsep.cli import overrides
from reflectsep.errors import SettingsError


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: config.FitSettings(n_s=-1.0), "fit.n_s=-1.0: must be above 0"),
        (lambda: config.FitSettings(tolerance=0.0), "fit.tolerance=0.0: must be above 0"),
        (lambda: config.FitSettings(tolerance=float("nan")), "fit.tolerance=nan: expected a number"),
        (lambda: config.FitSettings(lambda_basis=float("inf")), "fit.lambda_basis=inf: expected a number"),
        (lambda: config.FitSettings(max_iterations=0), "fit.max_iterations=0: must be at least 1"),
        (lambda: config.FitSettings(max_iterations=True), "fit.max_iterations=true: expected a whole number"),
        (
            lambda: config.FitSettings(method="jiont"),  # type: ignore[arg-type]
            "fit.method=jiont: expected joint or two_step; did you mean joint?",
        ),
        (lambda: config.ScatterSettings(n_d=0.0), "scatter.n_d=0.0: must be above 0"),
        (lambda: config.ScatterSettings(threshold=1.5), "scatter.threshold=1.5: must be at most 1"),
        (lambda: config.ScatterSettings(threshold="a"), "scatter.threshold=a: expected a number"),  # type: ignore[arg-type]
        (lambda: config.RigSettings(slab_width_px=-1), "rig.slab_width_px=-1: must be above 0"),
        (lambda: config.RigSettings(bits=40), "rig.bits=40: must be at most 16"),
        (lambda: config.ObjectSettings(channels=2), "object.channels=2: expected 1 or 3"),  # type: ignore[arg-type]
        (lambda: config.FitJob(capture="c", basis=["a", "b"]), "basis=[a,b]: expected 3 values, got 2"),
        (lambda: config.FitJob(capture="c", basis=["a", "b", "a"]), "basis=[a,b,a]: the three lights must differ"),
        (lambda: config.FitJob(capture="c", heldout=[1]), "heldout=[1]: expected a list of names or null"),  # type: ignore[list-item]
        (config.FitJob, "no capture: give capture=FOLDER"),
        (lambda: config.FitJob(object=3), "object=3: expected ObjectSettings"),  # type: ignore[arg-type]
        (lambda: config.RelightJob(result="r"), "no light is given"),
        (lambda: config.RelightJob(result="r", alpha=[1, 0, 0], orbit=3), "both alpha and orbit are given"),
        (lambda: config.RelightJob(result="r", direction=[0, 0, 0]), "direction=[0,0,0]: must not be zero"),
        (lambda: config.RelightJob(result="r", orbit=0), "orbit=0: must be at least 1"),
        (lambda: config.RelightJob(result="r", orbit=1, intensity=-1), "intensity=-1: must be at least 0"),
        (lambda: config.CompareJob(result="r", out="x.jpg"), "out=x.jpg: must end in .png"),
        (
            lambda: config.SimulateJob(object=config.ObjectSettings(name="../x")),
            "object.name=../x: must be a plain name",
        ),
    ],
)
def test_impossible_settings_say_what_is_possible(make, words):
    with pytest.raises(SettingsError) as caught:
        make()
    assert str(caught.value).startswith(words)
    assert "\n" not in str(caught.value)


@given(st.floats(allow_nan=True, allow_infinity=True))
def test_every_number_is_taken_exactly_where_it_is_within_bounds(n_s):
    possible = 0 < n_s <= 5000
    try:
        assert config.FitSettings(n_s=n_s).n_s == n_s
    except SettingsError:
        assert not possible
    else:
        assert possible


def test_default_folders_follow_the_object_and_an_unusual_rig():
    wax, twelve = config.ObjectSettings(name="wax"), config.RigSettings(name="twelve")
    assert config.SimulateJob(object=wax).out == config.FitJob(object=wax).capture == "captures/wax"
    assert config.FitJob(object=wax).out == "results/wax"
    assert config.SimulateJob(object=wax, rig=twelve).out == config.FitJob(object=wax, rig=twelve).capture
    assert config.SimulateJob(object=wax, rig=twelve).out == "captures/wax-twelve"
    assert config.FitJob(capture="somewhere/cat").out == "results/cat"
    assert config.FitJob(object=wax, capture="a", out="b").out == "b"


@pytest.mark.parametrize("cls", config.JOBS.values())
def test_every_setting_explains_itself(cls):
    def fields(of):
        for f in dataclasses.fields(of):
            kind = settings.kinds(of)[f.name]
            yield from fields(kind.base) if dataclasses.is_dataclass(kind.base) else [f]

    assert all(f.metadata.get("text") for f in fields(cls))


GROUP_OPTIONS = [
    (job, group, option)
    for job, cls in config.JOBS.items()
    for group in help_texts.groups(cls)
    for option in help_texts.group_options(group)
]


@pytest.mark.parametrize(("job", "group", "option"), GROUP_OPTIONS)
def test_every_group_option_makes_settings(job, group, option):
    extra = [] if job != "fit" else ["capture=c"]
    if option == "generic":
        extra = [*extra, "object.name=mine"]
    with overrides.hydra_ready():
        made = overrides.settings_of(job, [f"{group}={option}", *extra])
    value = getattr(made, group)
    named = {"scatter": "hole_filling", "object": "name", "rig": "name"}.get(group)
    assert named is None or getattr(value, named) == ("mine" if option == "generic" else option)


def test_group_options_have_a_line_of_help():
    assert all(text for _, group, _ in GROUP_OPTIONS for text in help_texts.group_options(group).values())


def test_yaml_defaults_are_the_dataclass_defaults():
    with overrides.hydra_ready():
        made = overrides.settings_of("fit", ["object=wax", "rig=clean"])
    assert isinstance(made, config.FitJob)
    assert made.fit == config.FitSettings()
    assert made.scatter == config.ScatterSettings()
    assert made.rig == config.RigSettings(name="clean")


@settings_of_hypothesis(max_examples=25, deadline=None)
@given(st.text(st.characters(codec="ascii", min_codepoint=32), min_size=1).filter(lambda t: t.strip() and "$" not in t))
def test_any_path_reaches_the_job_as_it_was_given(path):
    if path in ("null", "???") or path[0] in "'\"":
        return
    with overrides.hydra_ready():
        made = overrides.settings_of("info", overrides.checked("info", [f"path={path}"], sweeping=False))
    assert isinstance(made, config.InfoJob)
    assert made.path == path


def test_expansion_is_every_combination_in_order():
    runs = overrides.expanded(["object=wax,pudding", "fit.n_s=3,4", "seed=1"])
    expected = product(["object=wax", "object=pudding"], ["fit.n_s=3", "fit.n_s=4"], ["seed=1"])
    assert runs == [list(run) for run in expected]


def test_configs_are_found_in_a_source_tree():
    assert help_texts.config_dir() in (
        Path(config.__file__).parent / "configs",
        Path(config.__file__).parent.parent / "configs",
    )
