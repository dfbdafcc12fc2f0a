"""The relighting page: one offline HTML file that holds a result and draws it under any light."""
