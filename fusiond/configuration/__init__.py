"""Configuration: schema, reading, mistakes told by key, and what it means in SI units."""
