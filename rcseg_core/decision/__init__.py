"""One question, how complex a surface may be: together or apart, flat or bent (sections 6 and 7).

Answers from moments alone and never sees the image or the graph. May import: `models`, `signal`. For
others: `Rule` and `error_budget`, `compare`, `choose_degrees`, `describe` (the shortest description of a
region).
"""
