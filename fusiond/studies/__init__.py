"""Studies: the papers' experiments and what else a decision stands on, one module each.

A study module has `run(runs, seed, progress) -> dict` and `plot(result, path)`; it may have
`tables(result)` or `table(result)` for people. `runs` None is its own default.
"""

from __future__ import annotations

STUDIES = {
    "rdss-static": "fusiond.studies.rdss_static",
    "rdss-dynamic": "fusiond.studies.rdss_dynamic",
    "rdss-correlated": "fusiond.studies.rdss_correlated",
    "rdss-map": "fusiond.studies.rdss_map",
    "multiscale": "fusiond.studies.multiscale",
    "federated": "fusiond.studies.federated",
    "ukf": "fusiond.studies.ukf",
    "bds-tight": "fusiond.studies.bds_tight",
    "consistency": "fusiond.studies.consistency",
    "reduced-order": "fusiond.studies.reduced_order",
    "ins-gnss-sar": "fusiond.studies.ins_gnss_sar",
}
