"""What a paper would hold: training, its tables, the chart, stability, critical loads, peers, the ladder's figures."""
