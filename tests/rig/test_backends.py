"""Which devices can be named: the package's own, those of distributions that the user installed, and nothing else."""

import sys

import pytest

from reflectsep.errors import SettingsError
from reflectsep.rig.backends import build, build_devices
from reflectsep.rig.clock import VirtualClock

from .conftest import AXIS, complete

MODULE = """
from reflectsep.rig.simulated import SimulatedCamera

class Mine(SimulatedCamera):
    def __init__(self, *, serial, bench, clock=None):
        super().__init__(bench=bench)
        self.serial, self.clock = serial, clock

class Other:
    pass
"""
ENTRY_POINTS = """[reflectsep.rig]
camera.mine = my_cameras:Mine
camera.simulated = my_cameras:Other
camera.broken = my_cameras.nowhere:Broken
"""


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """A distribution `my-cameras`, as pip leaves it."""
    site = tmp_path / "site"
    information = site / "my_cameras-1.0.dist-info"
    information.mkdir(parents=True)
    (site / "my_cameras.py").write_text(MODULE)
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: my-cameras\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text(ENTRY_POINTS)
    monkeypatch.syspath_prepend(str(site))
    yield site
    sys.modules.pop("my_cameras", None)


def test_backend_of_an_installed_distribution_takes_a_session(installed, rig_in):
    rig = rig_in()
    config = {
        "stage": {"_target_": "simulated", "axes": {"x": AXIS}},
        "camera": {"_target_": "mine", "serial": "7"},
        "lights": {"_target_": "simulated"},
    }
    rig.devices = build_devices(config, clock=rig.bench.clock, bench=rig.bench)
    assert (type(rig.devices.camera).__name__, rig.devices.camera.serial) == ("Mine", "7")
    assert rig.devices.camera.clock is rig.bench.clock
    rig.run()
    assert complete(rig.folder).sweeps[0].count == 20


def test_settings_of_an_installed_backend_are_checked_as_those_of_the_package(installed, rig_in):
    session = {"clock": VirtualClock(), "bench": rig_in().bench}
    with pytest.raises(SettingsError, match=r"rig\.devices\.camera\.serial: mine needs it"):
        build("camera", {"_target_": "mine"}, **session)
    with pytest.raises(SettingsError, match=r"camera\.serail: no such setting of mine; did you mean serial\?"):
        build("camera", {"_target_": "mine", "serail": "7"}, **session)


def test_own_backend_is_not_replaced_by_an_installed_one(installed, rig_in):
    made = build("camera", {"_target_": "simulated"}, clock=VirtualClock(), bench=rig_in().bench)
    assert type(made).__module__ == "reflectsep.rig.simulated"


def test_installed_backend_that_cannot_be_imported_is_named(installed):
    words = r"camera: my_cameras\.nowhere:Broken of my-cameras cannot be imported: No module named"
    with pytest.raises(SettingsError, match=words):
        build("camera", {"_target_": "broken"}, clock=VirtualClock())


@pytest.mark.parametrize(
    "name",
    [
        "Mine",
        "my_cameras:Mine",
        "my_cameras.Mine",
        "camera.mine",
        "other",
        "os.system",
        "subprocess.Popen",
        "",
        7,
        None,
    ],
)
def test_what_no_list_names_is_refused_and_not_imported(installed, name):
    with pytest.raises(SettingsError, match=r"no such backend.*\(one of aravis, .*video, broken, mine\)"):
        build("camera", {"_target_": name}, clock=VirtualClock())
    assert "my_cameras" not in sys.modules


def test_backend_of_one_kind_is_none_of_another(installed):
    with pytest.raises(SettingsError, match=r"stage\._target_=mine: no such backend"):
        build("stage", {"_target_": "mine"}, clock=VirtualClock())


def test_without_the_distribution_its_backend_is_unknown():
    with pytest.raises(SettingsError, match=r"camera\._target_=mine: no such backend .*\(one of aravis, command, .*\)"):
        build("camera", {"_target_": "mine"}, clock=VirtualClock())
