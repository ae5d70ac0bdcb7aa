"""The figures of the thesis from our own estimators and calibrators."""
