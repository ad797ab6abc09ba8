"""The ground page: what the daemon sees and does, for a browser on the field.

`options` is the table of the configuration. `ground_page` owns the thread, and hands on what the frame path leaves with
it; `marks` turns outcomes into what can be drawn, `board` keeps what there is to show, `orthophoto` draws the map, and
`server` speaks HTTP as `http` reads it. The browser's side is in ``static``; `report` puts the same into one file.
"""
