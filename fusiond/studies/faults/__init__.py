"""The fault matrix: faults on values, each in the phases of a drive, and what the navigator says.

`python -m fusiond.studies.faults` runs it; `fusiond.studies.faults.error_sigma_score` says what a
verdict means.
"""
