"""Settings of the response surface and of the check by it, each with its reason."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class SurfaceSettings:
    """When a regression of f is believed, and what it is asked.

    What the last draws may have missed (`spread.py`), and where components belong (`placement.py`).
    """

    max_dim: int = 12
    """Dimensions, or slopes, up to which a regression is tried."""
    most_points: int = 6000
    """Last draws that are kept for it at most."""
    heavy_share: float = 0.01
    """A failing point is heavy where it would be more than this share of p as one of the last draws."""
    least_heavy: int = 3
    """Simulated failures that are heavy from which on a regression is made. Of 380
    runs on 38 states with nothing far off 54 came to that."""
    process_points: int = 600
    """Points that Kriging is conditioned on; as many more near the limit state test it."""
    piece_points: int = 2500
    """Points nearest to the limit state for the regression by pieces."""
    pieces: int = 12
    """Pieces to start with. With 24 those of four of twelve runs on a series system were not believed."""
    piece_fits: int = 8
    """Such regressions at most, from pieces around other failures; the one that is right most often is taken."""
    compressions: tuple[float, ...] = (3.0, 10.0)
    """Outcomes are tanh(f / (c s)), with s the median of their size at failures: what is far off matters little."""
    min_accuracy: float = 0.95
    """Share of points that the regression must place on the right side of the limit state: of points near it that the
    fit had not seen, and of all simulated points that it says fail."""
    min_heavy_accuracy: float = 0.8
    """The same of the simulated points that it says fail and that are heavy. Where f only seems to fall towards failure
    (a strip, a jump, a box off the way) it is below 0.02, on sums of loads and series systems 0.8 to 1."""
    min_placed_accuracy: float = 0.5
    """The same for the placement, which a regression that is wrong costs draws only. With 0.8 it was not tried in 8 of
    29 runs on loads_d7, and the mean second moment of the last mixtures by exact failures was 6.5 p^2 for 4.1."""
    chains: int = 600
    """Chains on the regression, from the failures met; their simulations cost nothing. With 300 that second moment was
    4.8 p^2 for 4.1 ..."""
    steps: int = 100
    """... and their steps, of which the second half counts. With 16 steps the c.o.v. of a series system was predicted
    at a fifth, for the chains had not left the places that draws reach."""
    max_ratio: float = 2.0
    """Predicted over stated c.o.v. from which on there is a warning. Of 400 runs without placement on a sum of loads
    and a series system three were far off, and all of these have it; with placement, of 366 with a true ratio below 1.5
    none has."""
    min_gain: float = 1.5
    """Second moment of the mixture by the failures met over that of the one by predicted failures from which on the
    latter is taken, both over states that neither was fitted to. On 56 limit states with 3 seeds each that was so in
    one run, and in nearly all on loads_d7."""
    gaussians: int = 8
    """Gaussians that are fitted to predicted failures at most. With one that second moment was 5.5 p^2 for 4.1."""
    kept_every: int = 10
    """Steps of a chain from one state that is kept to the next: those in between are much alike, and fits take longer
    with them. Chosen, not measured."""


DEFAULT_SURFACE_SETTINGS = SurfaceSettings()
LENGTHS = np.array([2.0, 4.0, 8.0, 14.0])
"""Correlation lengths that Kriging chooses from, in standard deviations."""
SEARCH_POINTS = 250
"""Points for that choice."""
NUGGET = 1e-4
"""Variance of what is no part of the process, over that of the residuals of the trend."""
