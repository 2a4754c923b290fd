"""Opens every port for some seconds and says what arrives and what is wrong."""
