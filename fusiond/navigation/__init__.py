"""Pure, compiled navigation numerics: no I/O, no clock, no configuration."""
