"""The report as one page of HTML that needs nothing beside it: no network, no font, no script but its own."""
