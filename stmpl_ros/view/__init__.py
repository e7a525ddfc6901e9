"""The viewer: a page in the browser with the skin of a recording, of the running node, or under a dragged tool."""
