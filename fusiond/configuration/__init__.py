"""Configuration: schema, reading, mistakes by key, conversion to SI units."""
