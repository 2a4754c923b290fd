"""The unscented filter against the extended one (paper 003)."""
