"""Carriers of two frequencies: slant delays, ways, learned noise; slips and jumps by name."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.raw.messages import CARRIER_HZ, SIGNAL_VALUES, SPEED_OF_LIGHT_M_S
from fusiond.gnss import carrier_phase as ca

Array = NDArray[np.float64]

L1 = SPEED_OF_LIGHT_M_S / CARRIER_HZ["G", "1"]
L2 = SPEED_OF_LIGHT_M_S / CARRIER_HZ["G", "2"]
GAMMA = (CARRIER_HZ["G", "1"] / CARRIER_HZ["G", "2"]) ** 2
DELAY_M = 1.7
NOON = 1000.0


class Told(NamedTuple):
    out: Array
    refused: list[int]
    jumped: bool


class Receiver:
    """Satellites `n` that move away with 300 m/s and more, each with its own delay."""

    def __init__(self, n: int = 4, code_m: float = 0.0, seed: int = 1) -> None:
        self.n, self.code_m = n, code_m
        self.kept = np.zeros((ca.SLOTS, ca.KEPT_COLUMNS))
        self.plan = np.array(
            [[k + 1, L1, L2, GAMMA, DELAY_M, 0.0, 7.0, 5.0] for k in range(n)], float
        )
        self.rng = np.random.default_rng(seed)
        self.t = NOON
        self.clock_m = 0.0
        self.cycles = np.zeros((n, 2))
        self.longer_m = np.zeros(n)
        """By a wall, both codes."""
        self.open = np.zeros((n, 2), bool)
        """Carriers with an open half cycle, which decoders leave out."""

    def delays(self) -> Array:
        """They grow by 2 mm/s."""
        found: Array = 3.0 + np.arange(self.n) + 0.002 * (self.t - NOON)
        return found

    def rates(self) -> Array:
        found: Array = 300.0 + 10.0 * np.arange(self.n)
        return found

    def epoch(
        self,
        lock_s: float = math.inf,
        doppler: bool = True,
        second_lock_s: float | None = None,
    ) -> Told:
        rho = 2.2e7 + self.rates() * (self.t - NOON) + self.clock_m
        noise = self.code_m * self.rng.standard_normal((2, self.n))
        i = self.delays()
        first = np.full((self.n, SIGNAL_VALUES), np.nan)
        first[:, ca.P] = rho + i + noise[0] + self.longer_m
        first[:, ca.RATE] = self.rates() if doppler else np.nan
        first[:, ca.CNO] = 45.0
        first[:, ca.CYCLES] = (rho - i) / L1 + 3e5 + self.cycles[:, 0]
        first[:, ca.LOCK] = lock_s
        second = np.full((self.n, SIGNAL_VALUES), np.nan)
        second[:, ca.P] = rho + GAMMA * i + DELAY_M + noise[1] + self.longer_m
        second[:, ca.CNO] = 45.0
        second[:, ca.CYCLES] = (rho - GAMMA * i) / L2 - 2e5 + self.cycles[:, 1]
        second[:, ca.LOCK] = lock_s if second_lock_s is None else second_lock_s
        first[self.open[:, 0], ca.CYCLES] = np.nan
        second[self.open[:, 1], ca.CYCLES] = np.nan
        out = np.empty((self.n, ca.OUT_COLUMNS))
        refused = np.empty(self.n, np.int64)
        found = ca.follow(self.kept, self.plan, first, second, self.t, out, refused)
        assert bool(found & ca.SOME_REFUSED) == bool(refused.any())
        return Told(out, refused.tolist(), bool(found & ca.JUMPED))

    def after(self, seconds: float, **how: float) -> Told:
        self.t += seconds
        return self.epoch(**how)


def test_the_first_epoch_is_the_ionosphere_free_pair() -> None:
    """A = 2 (1.2^2 + 0.3^2) / (gamma - 1)^2 = 2 x 1.53 / 0.41854 = 7.311 m^2 on L1 and L2, and the
    variance of P - I is (gamma^2 + 1) s^2 / (gamma - 1)^2 = 8.870 x 1.53 m^2."""
    told = Receiver().epoch()
    assert told.out[:, ca.SLANT] == pytest.approx([3.0, 4.0, 5.0, 6.0], abs=1e-6)
    assert told.out[0, ca.SLANT_VARIANCE] == pytest.approx(7.311, abs=2e-3)
    whole = 1.53 + told.out[0, ca.SLANT_VARIANCE] + told.out[0, ca.WITH_CODE]
    assert whole == pytest.approx(8.870 * 1.53, abs=5e-3)
    assert (told.out[:, ca.SPAN] == 0.0).all()
    assert told.refused == [ca.FOLLOWED] * 4


def test_carriers_say_how_the_delay_changes_and_codes_what_it_is() -> None:
    """Ten minutes: variance A / (1 + T / 2 tau) = A / 6; the mean of 600 white codes of 0.5 m is
    far better, for multipath of a minute is what it is made for."""
    receiver = Receiver(40, code_m=0.5)
    told = receiver.epoch()
    begun = told.out[0, ca.SLANT_VARIANCE]
    apart = []
    for _ in range(600):
        told = receiver.after(1.0)
        apart.append(told.out[:, ca.SLANT] - receiver.delays())
    assert np.sqrt(np.mean(np.square(apart[-1]))) < 0.35 * np.sqrt(np.mean(np.square(apart[0])))
    assert np.abs(np.diff(apart[-100:], axis=0)).max() < 0.02
    scale = ca.scale_squared(receiver.kept)
    assert told.out[0, ca.SLANT_VARIANCE] < begun / 5.0
    assert told.out[0, ca.SLANT_VARIANCE] > 0.3 * scale * begun / 6.0


@pytest.mark.parametrize(("code_m", "least", "most"), [(0.1, 0.09, 0.11), (1.2, 0.6, 1.3)])
def test_noise_of_codes_is_learned(code_m: float, least: float, most: float) -> None:
    """Of the model's 1.24 m RMS; no less than a tenth of its variance is believed."""
    receiver = Receiver(20, code_m=code_m)
    receiver.epoch()
    for _ in range(240):
        receiver.after(30.0)
    assert least < ca.scale_squared(receiver.kept) < most


def test_a_carrier_is_followed_from_epoch_to_epoch() -> None:
    """The range grows by 300 m/s, the delay, which a carrier has with the other sign, by 2 mm/s.
    Noise: 3^2 + 1.5^2 mm^2, on a wave of 190.3 mm in place of 190."""
    receiver = Receiver()
    first = receiver.epoch()
    told = receiver.after(0.25)
    moved = (told.out - first.out)[:, ca.CARRIER] / 0.25
    assert moved == pytest.approx(receiver.rates() - 0.002, abs=1e-6)
    assert (told.out[:, ca.SPAN] == 0.25).all()
    assert told.out[0, ca.CARRIER_VARIANCE] == pytest.approx(11.25e-6, rel=0.04)
    assert (receiver.after(ca.LONGEST_S + 0.1).out[:, ca.SPAN] == 0.0).all()


@pytest.mark.parametrize(
    ("which", "cycles", "doppler", "found"),
    [
        (0, 1.0, True, True),
        (1, 1.0, False, True),  # the second carrier's: by the two of them
        (0, 5.0, True, True),
        (0, 0.5, False, True),  # half a cycle, 95 mm: by the two of them
        (0, 0.05, True, False),  # 1 cm is noise
    ],
)
def test_slips_are_named_and_give_no_rate(
    which: int, cycles: float, doppler: bool, found: bool
) -> None:
    receiver = Receiver()
    receiver.epoch()
    receiver.after(0.25)
    receiver.cycles[2, which] += cycles
    told = receiver.after(0.25, doppler=doppler)
    assert told.refused == [0, 0, ca.CYCLE_SLIP if found else 0, 0]
    assert (told.out[2, ca.SPAN] == 0.0) == found
    assert (np.delete(told.out[:, ca.SPAN], 2) == 0.25).all()
    # the delay does not follow a slip, and the epoch after it is whole again
    assert told.out[2, ca.SLANT] == pytest.approx(receiver.delays()[2], abs=0.02)
    again = receiver.after(0.25)
    assert again.refused == [0, 0, 0, 0]
    moved = (again.out - told.out)[:, ca.CARRIER] / 0.25
    assert moved == pytest.approx(receiver.rates() - 0.002, abs=1e-6)


def test_a_lock_that_is_younger_than_the_epoch_before() -> None:
    receiver = Receiver()
    receiver.epoch()
    told = receiver.after(0.25, lock_s=0.1)
    assert told.refused == [ca.LOCK_LOST] * 4
    assert (told.out[:, ca.SPAN] == 0.0).all()
    assert receiver.after(0.25, lock_s=0.25).refused == [ca.FOLLOWED] * 4


@pytest.mark.parametrize("jump_s", [1e-3, -1e-3, 1e-8])
def test_a_clock_that_is_set_gives_no_rates_and_no_slips(jump_s: float) -> None:
    """By a millisecond, and by 3 m."""
    receiver = Receiver()
    receiver.epoch()
    receiver.after(0.25)
    receiver.clock_m += jump_s * SPEED_OF_LIGHT_M_S
    told = receiver.after(0.25)
    assert told.jumped
    assert told.refused == [ca.FOLLOWED] * 4
    assert (told.out[:, ca.SPAN] == 0.0).all()
    assert told.out[:, ca.SLANT] == pytest.approx(receiver.delays(), abs=1e-3)
    told = receiver.after(0.25)
    assert not told.jumped
    assert (told.out[:, ca.SPAN] == 0.25).all()


def test_another_first_signal_is_no_way_from_the_one_before() -> None:
    receiver = Receiver()
    receiver.epoch()
    receiver.plan[1, ca.SIGNAL] = 9.0
    told = receiver.after(0.25)
    assert told.out[:, ca.SPAN].tolist() == [0.25, 0.0, 0.25, 0.25]
    assert told.refused == [ca.FOLLOWED] * 4


def test_the_second_carrier_bridges_an_open_half_cycle_of_the_first() -> None:
    """The first comes back with another ambiguity. While the second serves, the path is shorter by
    gamma times the delay's growth of 2 mm/s."""
    receiver = Receiver(12, code_m=0.3)
    before = receiver.epoch()
    for _ in range(30):
        before = receiver.after(1.0)
    for k in range(12):
        receiver.open[:3, 0] = 2 <= k < 8
        receiver.cycles[:3, 0] += 1e4 * (k == 8)
        told = receiver.after(1.0)
        by_second = 2 <= k <= 8
        moved = (told.out - before.out)[:, ca.CARRIER]
        advance = np.where(np.arange(12) < 3, GAMMA if by_second else 1.0, 1.0)
        assert moved == pytest.approx(receiver.rates() - 0.002 * advance, abs=1e-6)
        assert told.refused == [ca.FOLLOWED] * 12
        assert (told.out[:, ca.SPAN] == 1.0).all()
        # (gamma - 1)^2 (1 mm/s)^2 30 s = 12.55e-6 m^2 a second, and two phases' at each change.
        noise = told.out[3, ca.CARRIER_VARIANCE] * (1.0 + GAMMA)
        grown = 12.55e-6 * by_second + noise * (k in (2, 9))
        assert told.out[:3, ca.GROWN] == pytest.approx(grown, rel=0.02, abs=0.0)
        assert (told.out[3:, ca.GROWN] == 0.0).all()
        assert receiver.epoch().out[:, ca.CARRIER] == pytest.approx(told.out[:, ca.CARRIER])
        before = told


def test_no_carrier_is_joined_over_an_epoch_that_has_neither() -> None:
    """Nor one that has both, but not the same one as the epoch before; the second may begin."""
    receiver = Receiver()
    receiver.open[0, 0] = True
    receiver.epoch()
    begun = receiver.after(0.25)
    assert (begun.out[:, ca.SPAN] == 0.25).all()
    receiver.open[0] = False, True
    receiver.open[1] = True, True
    told = receiver.after(0.25)
    assert told.out[:, ca.SPAN].tolist() == [0.0, 0.0, 0.25, 0.25]
    receiver.open[:] = False
    told = receiver.after(0.25)
    assert told.out[:, ca.SPAN].tolist() == [0.25, 0.0, 0.25, 0.25]
    assert told.refused == [ca.FOLLOWED] * 4


def test_a_lock_lost_by_the_first_carrier_alone_breaks_nothing() -> None:
    receiver = Receiver()
    receiver.epoch()
    before = receiver.after(0.25)
    receiver.cycles[:, 0] += 1e4
    told = receiver.after(0.25, lock_s=0.1, second_lock_s=math.inf)
    assert told.refused == [ca.FOLLOWED] * 4
    moved = (told.out - before.out)[:, ca.CARRIER] / 0.25
    assert moved == pytest.approx(receiver.rates() - 0.002 * GAMMA, abs=1e-6)


def test_the_same_epoch_again_changes_nothing() -> None:
    receiver = Receiver(code_m=1.0)
    receiver.epoch()
    receiver.after(1.0)
    kept = receiver.kept.copy()
    told = receiver.epoch()
    assert np.array_equal(receiver.kept, kept)
    assert (told.out[:, ca.SPAN] == 0.0).all()


@pytest.mark.parametrize("breaks", [False, True])
def test_a_code_that_goes_from_its_carrier_is_found(breaks: bool) -> None:
    """By 4 m beside a noise of 0.3 m, until it comes back, whether the carrier breaks off then or
    not: Dopplers bridge that."""
    receiver = Receiver(12, code_m=0.3)
    receiver.epoch()
    for _ in range(60):
        assert ca.MULTIPATH not in receiver.after(1.0).refused
    for longer_m, found in ((4.0, [ca.MULTIPATH] * 3), (0.0, [])):
        receiver.longer_m[:3] = longer_m
        receiver.cycles[:3] += 1e4 * breaks
        for k in range(20):
            told = receiver.after(1.0, lock_s=0.5 if breaks and k == 0 else math.inf)
            away = [code for code in told.refused if code == ca.MULTIPATH]
            assert away == found, (longer_m, k)


def test_a_code_that_falls_back_was_too_long() -> None:
    """One that was heard by a wall first is the better for it, and one that stays away for two
    minutes is taken as it is."""
    receiver = Receiver(12, code_m=0.3)
    receiver.longer_m[:] = 10.0
    receiver.epoch()
    for _ in range(60):
        receiver.after(1.0)
    receiver.longer_m[:6] = 0.0
    for _ in range(20):
        assert ca.MULTIPATH not in receiver.after(1.0).refused
    receiver.longer_m[:6] = 10.0
    away = [receiver.after(1.0).refused.count(ca.MULTIPATH) for _ in range(int(ca.FORGOTTEN_S) + 2)]
    assert away[:100] == [6] * 100
    assert away[-1] == 0


def test_a_clock_that_is_set_is_no_reflection() -> None:
    receiver = Receiver(12, code_m=0.3)
    receiver.epoch()
    for _ in range(30):
        receiver.after(1.0)
    receiver.clock_m = 299_792.458
    for _ in range(20):
        assert ca.MULTIPATH not in receiver.after(1.0).refused
