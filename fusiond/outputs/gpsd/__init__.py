"""gpsd's JSON protocol: requests, reports, and the server that gpsd's clients talk to."""
