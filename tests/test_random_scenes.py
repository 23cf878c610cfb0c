"""Both loops of the renderer give the same bits for 125 random scenes. `python -m tests.random_scenes` compares ten thousand."""

from __future__ import annotations

import pytest

from tests import random_fields
from tests.random_scenes import Outcome, plan_of_scene, render
from wrt.renderer.plan import switches
from wrt.scene.backgrounds import BACKGROUNDS
from wrt.scene.cameras import CAMERAS
from wrt.scene.kinds import forms
from wrt.scene.settings import Settings
from wrt.scene.values import FORMS

# Together these groups use every feature. If a new feature is in none of them, choose other groups.
GROUPS = 95, 118, 137, 144
SCENES = 25  # in each group


def test_every_form_of_a_field_is_drawn() -> None:
    assert random_fields.DRAWS.keys() == FORMS.keys()


def test_the_groups_use_every_feature() -> None:
    plans = [plan_of_scene(group, 0) for group in GROUPS]
    on_off = [switches(plan.features) for plan in plans]
    assert {name for name in on_off[0] if not any(each[name] for each in on_off)} == set()
    assert {plan.camera.kind for plan in plans} == CAMERAS.keys()
    assert {plan.scene.background.kind for plan in plans} == BACKGROUNDS.keys()
    for name, field in forms(Settings).items():
        if field.metadata["form"] == "choice" and name != "tonemap":
            assert {getattr(plan.scene.settings, name) for plan in plans} == set(field.metadata["limits"]["among"]), name
    assert {bool(plan.options.aov) for plan in plans} == {False, True}


@pytest.mark.parametrize("group", GROUPS)
def test_both_loops_give_the_same_bits(group: int) -> None:
    outcomes = [render(group, seed) for seed in range(SCENES)]
    assert {seed: outcome.differ for seed, outcome in enumerate(outcomes) if outcome.differ} == {}
    assert sum(map(is_lit, outcomes)) > SCENES / 4 and any(map(goes_on, outcomes))  # the comparison is not of black pictures


def is_lit(outcome: Outcome) -> bool:
    return bool(outcome.film["mean of group 0"].any())


def goes_on(outcome: Outcome) -> bool:
    """Return whether a pixel has more than 6 rays: two camera rays for each of three samples at most, so that some bounce."""
    return bool(outcome.film["rays"].max() > 6)
