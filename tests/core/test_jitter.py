"""The width of the prior, judged from poses drawn with a known width and known errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatcore.geometry import RigidMotions
from splatcore.jitter import narrowed
from splatcore.poses import Prior

WIDE = Prior(rotation=0.1, translation=10.0)
VIEWS = 60
ERROR = np.array([0.001] * 3 + [0.1] * 3)  # the volume known: what the information says


def drawn(rotation: float, translation: float, seed: int) -> tuple[RigidMotions, np.ndarray]:
    """Poses of these widths, found with twice the error that the information admits (the volume was unknown)."""
    rng = np.random.default_rng(seed)
    poses = rng.normal(size=(VIEWS, 6)) * ([rotation] * 3 + [translation] * 3) + 2 * ERROR * rng.normal(size=(VIEWS, 6))
    return RigidMotions.exp(poses[:, :3], poses[:, 3:]), np.tile(np.diag(ERROR**-2.0), (VIEWS, 1, 1))


@pytest.mark.parametrize("seed", range(5))
def test_width_is_never_less_than_the_true_one_nor_much_more(seed):
    for rotation, translation in ((0.002, 0.2), (0.01, 0.5), (0.05, 5.0)):
        found = narrowed(WIDE, *drawn(rotation, translation, seed))
        assert 1.0 < found.rotation / rotation < 2.2
        assert 1.0 < found.translation / translation < 2.2


@pytest.mark.parametrize("seed", range(5))
def test_poses_that_are_noise_leave_a_prior_that_is_narrower_than_the_noise(seed):
    found = narrowed(WIDE, *drawn(0.0, 0.0, seed))
    assert found.rotation < 2 * ERROR[0] and found.translation < 2 * ERROR[3]


def test_a_stated_tolerance_is_never_widened():
    tight = replace(WIDE, rotation=1e-5, translation=1e-3)
    assert narrowed(tight, *drawn(0.05, 5.0, 0)) == tight
    still = RigidMotions.identity(VIEWS)
    assert narrowed(WIDE, still, drawn(0.0, 0.0, 0)[1]) == WIDE  # nothing moved, nothing is learnt


def test_units_do_not_matter():
    motions, known = drawn(0.002, 0.2, 1)
    scaled = RigidMotions(motions.rotation, 25.4 * motions.translation)
    unit = np.diag([1.0] * 3 + [1 / 25.4] * 3)
    inches, plain = (
        narrowed(replace(WIDE, translation=254.0), scaled, unit @ known @ unit),
        narrowed(WIDE, motions, known),
    )
    assert inches.rotation == pytest.approx(plain.rotation) and inches.translation == pytest.approx(
        25.4 * plain.translation
    )


def test_what_no_view_shows_does_not_disturb():
    """Shifts along x leave no trace: the others still tell the width."""
    motions, known = drawn(0.002, 0.2, 2)
    unseen = np.diag([1.0, 1, 1, 0, 1, 1])
    found = narrowed(WIDE, motions, unseen @ known @ unseen)
    assert 1.0 < found.rotation / 0.002 < 2.2 and 0.8 < found.translation / 0.2 < 3
