"""Speed of devices other than the processor."""
