"""Numbers that the paper prints, and what its released code does."""

from __future__ import annotations

from dataclasses import dataclass

TIAN_SOURCE = (
    "Tian, Fu, Zhang, Tang, Sun: Accelerated verification of autonomous driving systems based on adaptive subset "
    "simulation. IEEE Transactions on Intelligent Vehicles, 2024, doi:10.1109/TIV.2024.3449947."
)


@dataclass(frozen=True)
class PrintedRow:
    """One row of Table II or III; None where nothing is printed."""

    p: float | None = None
    squared_cov: float | None = None
    """The column "COV", which is the square of a c.o.v.: for MCS and IS it is about (1 - p) / (p N)."""
    n_sim: float | None = None
    error: float | None = None
    """Relative error of the mean against Monte Carlo."""
    mcs: float | None = None
    """p by Monte Carlo."""

    @property
    def cov(self) -> float | None:
        """Root of the printed column."""
        return None if self.squared_cov is None else self.squared_cov**0.5

    @property
    def gain(self) -> float | None:
        """Variance of plain Monte Carlo with as many simulations over the mean square error; see `mcs`."""
        if self.p is None or self.squared_cov is None or self.n_sim is None or self.mcs is None:
            return None
        ratio = self.p / self.mcs
        square_error = self.squared_cov * ratio**2 + (ratio - 1.0) ** 2
        return (1.0 - self.mcs) / (self.mcs * self.n_sim * square_error)


def _table2(p: float, squared_cov: float, n_sim: float, mcs: float) -> PrintedRow:
    return PrintedRow(p, squared_cov, n_sim, None if p == mcs else abs(p / mcs - 1.0), mcs)


PRINTED = {
    ("car-following", "stack", "MCS"): _table2(2.392e-4, 0.009, 4.064e5, 2.392e-4),
    ("car-following", "stack", "SS"): _table2(2.351e-4, 0.213, 4.980e3, 2.392e-4),
    ("car-following", "stack", "ADSS"): _table2(2.347e-4, 0.086, 2.681e3, 2.392e-4),
    ("car-following", "stack", "IS"): _table2(2.013e-4, 0.026, 1.762e5, 2.392e-4),
    ("car-following", "IDM", "MCS"): _table2(8.36e-4, 0.004, 2.351e5, 8.36e-4),
    ("car-following", "IDM", "SS"): _table2(8.03e-4, 0.152, 1.6e3, 8.36e-4),
    ("car-following", "IDM", "ADSS"): _table2(8.16e-4, 0.073, 1.533e3, 8.36e-4),
    ("car-following", "IDM", "IS"): _table2(8.23e-4, 0.012, 9.569e4, 8.36e-4),
    ("cut-in", "stack", "MCS"): PrintedRow(p=2.58e-4),
    ("cut-in", "stack", "SS"): PrintedRow(p=2.49e-4, n_sim=5000, error=0.026),
    ("cut-in", "stack", "ADSS"): PrintedRow(n_sim=237_000 / 112),
    ("cut-in", "stack", "IS"): PrintedRow(p=2.86e-4, n_sim=237_000, error=0.171),
    ("cut-in", "IDM", "IS"): PrintedRow(error=0.038),
}
"""By scenario, system (`stack` for Apollo) and the paper's name of the method.

Of Table III only what the text repeats: p and n_sim of single runs with Apollo, the errors over 20 replications, and
that ADSS is 112 times faster than IS, from which its n_sim is derived.
"""

RELEASED = {
    "MCS": "stops where the 95 % interval is p (1 ± 0.2): N = 96 (1 - p) / p",
    "IS": "does not run as released; adds weighted draws of the tilt and unweighted base draws in one mean",
    "SS": "does not run as released; 5,000 points a level (text: 500); maps to normal space by marginals",
    "ADSS": "AR-1 proposals without a Metropolis ratio; first step 0.6 of the base's spread (text: of the seeds')",
}
"""What the code does that the paper names as its source, by method."""
MOST_HALF_WIDTH_DRAWS = 96.04
"""(1.96 / 0.2)^2: draws of the stop rule times p / (1 - p)."""
EXPLANATIONS = {
    "traffic": (
        "The paper draws scenarios from Gaussian mixtures fitted to 30,292 car-followings and 993 cut-ins of highD, "
        "which are not public. Ours is the base `highway`, assembled from published statistics of such traffic. p is "
        "therefore another probability; what can be compared is how far a method is from Monte Carlo and what it costs."
    ),
    "system": (
        "Apollo 7.0 in LGSVL is replaced by `noisy:idm`: the IDM behind errors of perception, latency and lagging "
        "actuators. Its noise is part of x here (175 and 275 further dimensions), so that f is a function and every "
        "failure replays; Apollo's noise comes anew with each simulation."
    ),
    "limit state": (
        "f is the same by definition: -1 with a collision, else the least time to collision. The released code takes "
        "the time to every vehicle ahead, whatever its lane, ours to the one in the ego's way: other levels, the same "
        "failures. Episodes last 5 s in steps of 0.1 s in both."
    ),
    "squared": (
        "The printed column COV is the square of a c.o.v.: (1 - p) / (p N), that of plain Monte Carlo, is 0.0103, "
        "0.0051, 0.0282 and 0.0127 for MCS and IS with Apollo and the IDM, where 0.009, 0.004, 0.026 and 0.012 are "
        "printed. The paper's c.o.v. in this table is its root."
    ),
    "weights": (
        "The printed COV of IS is about that of as many plain Monte Carlo draws: its tilt reduces no variance. Ours "
        "weights every draw by the density of the mixture that it came from. With the stack a tilt of hundreds of "
        "coordinates leads nowhere, which our method sees and then draws from the base distribution."
    ),
    "settings": (
        "500 points a level, as the text has it, make at most 2,000 simulations in four levels. The printed 4,980 of "
        "SS with Apollo needs more points, and with them a smaller c.o.v. The released code of ADSS makes N further "
        "ones after its last level, which no estimate uses: 2,500 in four levels, 3,000 in five, around the printed "
        "2,681."
    ),
    "stop rule": (
        "Monte Carlo stops at 20 % relative half-width, which is (1 - p) / p times 96 draws; the printed number with "
        "the IDM is twice what the rule gives for its p. Ours looks after every 10,000 draws."
    ),
    "counting": (
        "All simulations are counted outside the methods, the search of IS included. The released code makes N of "
        "them in every level: ADSS simulates the seeds again, SS leaves them out of its chains. Ours keeps their "
        "outcome: 0.9 N."
    ),
    "chance": (
        "The mean of 20 replications with a c.o.v. of 0.3 to 0.5 has a standard error of 7 to 11 %: printed errors of "
        "2 or 3 % are smaller than chance explains, and ours differ from them by chance as well. "
        "The c.o.v. of few replications is itself uncertain: see its interval."
    ),
    "text": "Table III itself is not in the text at hand: single runs and figures that the text repeats, see above.",
}
"""Why numbers differ, by the words in the table."""
