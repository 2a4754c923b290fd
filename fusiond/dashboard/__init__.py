"""Dashboard of a vehicle in a browser: from its topics, or from a recording of them.

A process of its own, which knows the daemon only by `docs/mqtt.md`: no browser costs a tick.
"""
