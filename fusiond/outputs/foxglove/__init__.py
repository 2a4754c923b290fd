"""Foxglove's WebSocket protocol: channels, and a server for Foxglove and Lichtblick."""
