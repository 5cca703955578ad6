"""Safety properties that hold in every run, checked on every frame by code that shares nothing with the firmware."""
