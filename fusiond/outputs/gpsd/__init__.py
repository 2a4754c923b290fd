"""gpsd's JSON protocol: requests, reports, and the server for gpsd's clients."""
