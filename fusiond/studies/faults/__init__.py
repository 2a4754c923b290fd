"""Fault matrix: faults on values, each in the phases of a drive, and the navigator's response.

`python -m fusiond.studies.faults` runs it; `fusiond.studies.faults.error_sigma_score` defines the
verdicts.
"""
