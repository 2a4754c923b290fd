"""Initial alignment: from received data to the filter's first state."""
