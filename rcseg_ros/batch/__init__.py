"""Many recordings: a manifest of units of work, runners that share them out, tables that come of it.

`inputs` finds recordings, `manifest` remembers them and parts long ones, `work` turns one unit into tables,
`runners` (and `ray_runner`) spread units over processes, `run` does what is missing, `report` shows it.
Builds on the replay of `commands` and on `tables`; nothing but the command line imports it.
"""
