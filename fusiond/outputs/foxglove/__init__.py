"""Foxglove's WebSocket protocol: channels, and the server that Foxglove and Lichtblick open."""
