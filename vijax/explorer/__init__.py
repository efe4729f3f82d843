"""A page in the browser that shows a map and, of the cell that is picked, its motion and what surrounds it.

The only folder that imports bokeh, and never before a page is asked for. Every panel shows the answer of a public
function, which it names. Begin with `page`; what a panel computes stands in the room of its name.
"""
