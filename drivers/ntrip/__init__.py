"""Corrections of an NTRIP caster, written to the receiver: see `docs/network.md`."""
