"""The messages of the MQTT topics, a module each: flat JSON, units in the names as in the files."""
