"""Studies: the papers' experiments and what else a decision stands on, one module each.

A study module has `run(runs, seed, progress) -> dict` and `plot(result, path)`; it may have
`tables(result)` or `table(result)` for people. `runs` None is its own default.
"""

from __future__ import annotations

STUDIES = {
    "rdss-static": "fusiond.studies.rdss.static",
    "rdss-dynamic": "fusiond.studies.rdss.dynamic",
    "rdss-correlated": "fusiond.studies.rdss.correlated",
    "rdss-map": "fusiond.studies.rdss.map",
    "multiscale": "fusiond.studies.multiscale.study",
    "federated": "fusiond.studies.federated.study",
    "ukf": "fusiond.studies.ukf.study",
    "bds-tight": "fusiond.studies.bds_tight.study",
    "consistency": "fusiond.studies.consistency",
    "reduced-order": "fusiond.studies.reduced_order.study",
    "protection": "fusiond.studies.protection",
    "vehicle": "fusiond.studies.vehicle.study",
    "ins-gnss-sar": "fusiond.studies.ins_gnss_sar",
}
