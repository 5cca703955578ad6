"""The bench: ECUs, buses, plant, sensor models and scenarios in one lock-step loop, with its recorder."""
