"""What is said of a result."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pytest
import torch

from reflectsep.summary import refined_alphas


@dataclass
class Stack:
    names: tuple
    alpha: torch.Tensor
    light_vectors: torch.Tensor | None


@dataclass
class Refined:
    alpha: torch.Tensor | None
    alpha_sd: torch.Tensor | None


def test_refined_alphas_are_said_in_degrees_and_per_cent():
    basis = 2.0 * torch.eye(3)
    stated = torch.cat([torch.eye(3), torch.tensor([[0.0, 0.0, 1.0]])])
    turned, stronger = math.radians(3.0), 1.05
    refined = stated.clone()
    refined[3] = stronger * torch.tensor([math.sin(turned), 0.0, math.cos(turned)])
    stack = Stack(("L1", "L2", "L3", "L4"), stated, torch.cat([basis, stated[3:] @ basis]))
    found = refined_alphas(stack, Refined(refined, torch.full((4, 3), 0.01)))["alpha_refined"]
    assert list(found) == ["L4"]
    assert found["L4"]["turned_deg"] == pytest.approx(3.0, abs=1e-4)
    assert found["L4"]["intensity_percent"] == pytest.approx(5.0, abs=1e-4)
    assert found["L4"]["stated"] == [0.0, 0.0, 1.0]
    assert (
        "turned_deg"
        not in refined_alphas(Stack(stack.names, stated, None), Refined(refined, stated))["alpha_refined"]["L4"]
    )
    assert refined_alphas(stack, Refined(None, None)) == {}
