"""Studies: experiments of the papers and those behind design decisions, one module each.

A study module has `run_study(runs, seed, progress) -> dict` and `plot(result, path)`; it may have
`tables(result)` or `table(result)` for people. `runs` None is its own default.
"""

from __future__ import annotations

from typing import NamedTuple

STUDIES = {
    "rdss-static": "fusiond.studies.rdss.static",
    "rdss-dynamic": "fusiond.studies.rdss.dynamic",
    "rdss-correlated": "fusiond.studies.rdss.correlated",
    "rdss-map": "fusiond.studies.rdss.map",
    "multiscale": "fusiond.studies.multiscale.study",
    "federated": "fusiond.studies.federated.study",
    "ukf": "fusiond.studies.ukf.study",
    "bds-tight": "fusiond.studies.bds_tight.study",
    "consistency": "fusiond.studies.consistency_verdict_errors",
    "reduced-order": "fusiond.studies.reduced_order.study",
    "protection": "fusiond.studies.protection",
    "vehicle": "fusiond.studies.vehicle_parameters.study",
    "ins-gnss-sar": "fusiond.studies.ins_gnss_sar",
    "drives": "fusiond.studies.random_drives_study",
    "papers": "fusiond.studies.paper_models_nees",
}


class About(NamedTuple):
    """Study: question and default number of runs."""

    text: str
    runs: int
    rows: bool = True
    """True if each run can be stored as a row; False if all runs are drawn at once."""


ABOUT = {
    "rdss-static": About(
        "Paper 000 at rest: late RDSS fixes by four strategies, 55 of them.",
        500,
    ),
    "rdss-dynamic": About(
        "Paper 000 on a drive: turns, stops, slow terminals, outages.",
        100,
    ),
    "rdss-correlated": About(
        "Fixes that share an error: filters that ignore or estimate it.",
        100,
    ),
    "rdss-map": About(
        "Sigma of an RDSS fix over latitude and longitude.",
        2000,
        rows=False,
    ),
    "multiscale": About(
        "Paper 001: a block filter on wavelets against two others.",
        100,
    ),
    "federated": About(
        "Paper 004: federated filters, and faults in one of their parts.",
        50,
    ),
    "ukf": About(
        "Paper 003: unscented against extended filter, fair and poor starts.",
        50,
    ),
    "bds-tight": About(
        "BeiDou pseudoranges in the filter against a receiver's fixes.",
        50,
    ),
    "consistency": About(
        "How often the verdict on sigma is wrong, how soon it sees a fault.",
        20_000,
        rows=False,
    ),
    "reduced-order": About(
        "Paper 002: 23 states of INS/GNSS/SAR against 17, by covariance.",
        40,
    ),
    "protection": About(
        "Whether errors stay below the protection levels; their cost.",
        20,
    ),
    "vehicle": About(
        "Mounting, scales, lever arms that the filter finds: honest sigma?",
        60,
    ),
    "ins-gnss-sar": About(
        "Paper 002 flown: 23 states against 17, four satellites against all.",
        50,
    ),
    "drives": About(
        "Drives of a minute drawn at random, a row of figures each.",
        200,
    ),
    "papers": About(
        "Every paper's model live: is its sigma honest, group by group?",
        12,
    ),
}
