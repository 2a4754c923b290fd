"""The unscented filter."""
