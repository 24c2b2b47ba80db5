"""Running a method: arguments, the ask-tell dialogue, the evaluation log, replicates and faults."""
