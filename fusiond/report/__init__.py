"""What happened on a drive, as one page: from logs and solution files, never from the daemon."""
