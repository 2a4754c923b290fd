"""Initial alignment: from what has come in to the filter's first state."""
