"""A page in the browser that shows a map, and the motion and the surroundings of a selected cell.

No other folder imports bokeh, which is loaded when a page is opened. `server` runs pages and their jobs. `analyses`
computes the contents of the panels; every panel names the public function that computes its result. Begin with `page`.
"""
