"""Report of a drive on one page: from logs and solution files, never from the daemon."""
