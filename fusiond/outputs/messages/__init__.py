"""Messages of the MQTT topics, one module each: flat JSON with units in the names."""
