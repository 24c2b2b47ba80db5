"""Control: actions of policies, HighwayEnv's meta-actions and steering, the IDM, lane changes and human drivers."""
