"""Pictures and videos of robots, drawn without a screen."""
