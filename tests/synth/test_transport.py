import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from reflectsep.synth import transport as module
from reflectsep.synth.kernels import ExponentialKernel
from reflectsep.synth.objects import Material, from_height
from reflectsep.synth.presets import make_object
from reflectsep.synth.rig import direction
from reflectsep.synth.shading import irradiance
from reflectsep.synth.transport import transmitted, transport

SCATTERING = ("wax", "pudding", "marble", "skin", "turtle")
DISTANCES = ("chord", "plane")


def flat(size, length=1.5, ior=1.0001):
    material = Material(
        name="m", diffuse=(0.1,), scattering=(0.8,), kernels=(ExponentialKernel((1.0,), (length,)),), ior=ior
    )
    return from_height("flat", lambda x, y: 0 * x + 0 * y, size=(size, size), materials=(material,))


def operator(obj, distance):
    """K itself, channel 0, without the transmission outwards and the area of the source: (to, from)."""
    made = transport(obj, distance)
    count = len(made.points)
    return made.spread(torch.eye(count, dtype=torch.float64))[0] / made.out[:, None] / made.area


@pytest.mark.parametrize("name", SCATTERING)
@pytest.mark.parametrize("distance", DISTANCES)
def test_transport_is_reciprocal_and_never_negative(name, distance):
    kernel = operator(make_object(name, size=20), distance)
    scale = float(kernel.max())
    assert scale > 0
    assert (kernel - kernel.mT).abs().max() < 1e-9 * scale
    assert kernel.min() > -1e-9 * scale


@pytest.mark.parametrize("name", SCATTERING)
@pytest.mark.parametrize("distance", DISTANCES)
def test_no_patch_gives_out_more_light_than_entered_it(name, distance):
    obj = make_object(name, size=40)
    made = transport(obj, distance)
    # Flux that entered at i leaves through all j: sum_j K(j, i) A_j, with what leaves through i itself.
    left = (operator(obj, distance) * made.area[:, None]).sum(0) + made.self_share()[0]
    local = torch.tensor([material.diffuse[0] for material in obj.materials], dtype=torch.float64)
    assert (left + local[obj.patch_material]).max() < 1


def test_a_chord_is_summed_as_by_a_plain_loop():
    obj = make_object("pudding", size=16)
    made = transport(obj, "chord")
    points, material = obj.points, obj.patch_material.tolist()
    entering = torch.rand(len(points), dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    result = made.spread(entering[:, None])[0, :, 0]
    for j in (0, 17, len(points) // 2, len(points) - 3):
        total = 0.0
        for i in range(len(points)):
            if i == j:
                continue
            r = math.dist(points[i].tolist(), points[j].tolist())
            ends = [obj.materials[material[k]] for k in (i, j)]
            spread = []
            for end in ends:
                weights, lengths = end.kernels[0].weights, end.kernels[0].lengths_px
                terms = zip(weights, lengths, strict=True)
                value = sum(w * math.exp(-r / length) / (2 * math.pi * length**2) for w, length in terms)
                spread.append(value * end.scattering[0])
            total += math.sqrt(spread[0] * spread[1]) * float(entering[i]) / float(obj.patch_normals[i, 2])
        cosine, ior = float(obj.patch_normals[j, 2]), obj.materials[material[j]].ior
        facing = ((ior - 1) / (ior + 1)) ** 2
        out = 1 - facing - (1 - facing) * (1 - cosine) ** 5
        assert float(result[j]) == pytest.approx(total * out / math.pi, rel=1e-9)


@pytest.mark.parametrize("distance", DISTANCES)
def test_an_even_light_on_a_flat_plate_comes_out_evenly(distance):
    """Far from the edge everything that entered leaves: albedo / pi per unit irradiance, self share included."""
    obj = flat(61)
    made = transport(obj, distance)
    even = torch.ones(len(made.points), 1, dtype=torch.float64)
    out = obj.picture(made.spread(even)[..., 0] + made.self_share() * made.out)[0]
    assert float(out[30, 30]) * math.pi == pytest.approx(0.8, rel=0.03)


def test_on_a_flat_plate_plane_and_chord_agree():
    obj = flat(24, length=1.2, ior=1.4)
    light = torch.rand(len(obj.points), 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for beyond in (0, 1, 2):
        exact, fast = (transport(obj, distance).spread(light, beyond) for distance in DISTANCES)
        assert (exact - fast).abs().max() < 2e-4 * exact.max()


def test_on_a_bumpy_object_the_plane_is_near_the_chord():
    obj = make_object("wax", size=48)
    light = torch.tensor(direction(25, 60), dtype=torch.float64)
    entering = transmitted(obj, light, irradiance(obj, light))[:, None]
    exact, fast = (transport(obj, distance).spread(entering) for distance in DISTANCES)
    inner = obj.patch_normals[:, 2] > 0.5
    assert float((exact - fast)[0, inner].norm() / exact[0, inner].norm()) < 0.10


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000), st.floats(-3, 3), st.floats(-3, 3), st.sampled_from(DISTANCES), st.sampled_from((0, 1, 2)))
def test_transport_is_linear(seed, p, q, distance, beyond):
    made = transport(make_object("pudding", size=18, channels=3), distance)
    e, f = torch.rand(2, len(made.points), 1, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    mixed = made.spread(p * e + q * f, beyond)
    assert torch.allclose(mixed, p * made.spread(e, beyond) + q * made.spread(f, beyond), atol=1e-10)


@pytest.mark.parametrize("distance", DISTANCES)
def test_a_patch_gives_nothing_to_itself_and_less_the_further_it_must_go(distance):
    obj = flat(15)
    made = transport(obj, distance)
    one = obj.mask & False
    one[7, 7] = True
    beam = one[obj.mask].double()[:, None]
    by_distance = [obj.picture(made.spread(beam, px)[..., 0])[0] for px in (0, 1, 2)]
    largest = by_distance[0].max()
    assert by_distance[0][7, 7].abs() < 1e-9 * largest
    assert (by_distance[0] >= by_distance[1] - 1e-9 * largest).all()
    assert (by_distance[1] >= by_distance[2] - 1e-9 * largest).all()
    # A neighbour's footprint is half beyond one pixel and not at all beyond two; one three away is all beyond both.
    assert by_distance[1][7, 8] == pytest.approx(by_distance[0][7, 8] / 2)
    assert by_distance[2][7, 8].abs() < 1e-9 * largest
    assert by_distance[2][7, 10] == pytest.approx(by_distance[0][7, 10])


def test_an_opaque_object_scatters_nothing():
    made = transport(make_object("plastic", size=24))
    light = torch.ones(len(made.points), 2, dtype=torch.float64)
    for distance in DISTANCES:
        assert not transport(made.obj, distance).spread(light).any()
    assert not made.self_share().any()


def test_blocks_do_not_change_the_result(monkeypatch):
    made = transport(make_object("pudding", size=20))
    light = torch.rand(len(made.points), 2, dtype=torch.float64)
    whole = made.spread(light)
    monkeypatch.setattr(module, "BLOCK_ELEMENTS", 1000)
    told = []
    assert torch.allclose(made.spread(light, done=lambda at, of: told.append((at, of))), whole, atol=1e-13)
    assert told[-1][0] == told[-1][1] == len(told) > 3


def test_light_is_lost_by_fresnel_on_its_way_in():
    obj = flat(4, ior=1.5)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    assert transmitted(obj, up, torch.ones(16, dtype=torch.float64)) == pytest.approx(torch.full((16,), 0.96))


def test_large_objects_take_the_plane(monkeypatch):
    obj = make_object("wax", size=24)
    assert transport(obj).distance == "chord"
    monkeypatch.setattr(module, "MOST_CHORD_PATCHES", 10)
    assert transport(obj).distance == "plane"
