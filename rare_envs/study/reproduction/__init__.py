"""Tables and figures of published papers, made anew and set beside those that were printed."""
