"""Places of a model in which two different things are: meetings finds them, false_joins the pairs that are to blame."""
