"""Diagnosis of every port: what arrives within some seconds, and what is wrong."""
