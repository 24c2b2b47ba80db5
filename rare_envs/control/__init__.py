"""Control: actions, meta-actions, the Intelligent Driver Model and steering."""
