"""The one example that DHP19's authors evaluate in public, as they print it.

Source: SensorsINI/DHP19, Eval_2D_triangulation_and_3D_tutorial.ipynb, printed output: subject 16, session 2,
movement 1, image 24, cameras 2 and 3. Joints are (row, column), rows from the top: labels as the pixels they lie in,
predictions as the highest pixels of the heatmaps.
"""

LABELS = {
    2: [(45, 124), (72, 129), (70, 158), (101, 142), (111, 169), (126, 130), (129, 151), (134, 135), (144, 156),
        (172, 113), (178, 149), (216, 129), (231, 144)],
    3: [(36, 197), (71, 163), (58, 193), (101, 155), (92, 203), (123, 183), (114, 199), (138, 158), (117, 224),
        (171, 198), (163, 194), (214, 187), (211, 204)],
}  # fmt: skip
PREDICTED = {
    2: [(32, 132), (68, 131), (68, 161), (100, 142), (106, 171), (118, 135), (127, 157), (126, 130), (147, 159),
        (168, 117), (175, 154), (211, 134), (223, 153)],
    3: [(24, 186), (67, 160), (54, 189), (105, 151), (88, 199), (118, 179), (109, 196), (136, 156), (112, 220),
        (168, 195), (163, 195), (210, 184), (206, 202)],
}  # fmt: skip
PUBLISHED_PX = {2: 6.9048320282, 3: 5.79560125641}
PUBLISHED_MM = 66.3753692654
