"""Words that a mesh script may use: those of gmsh that describe geometry and mesh size.

Sources: gmsh 4.8 to 4.15: ``src/parser/Gmsh.l`` and ``Gmsh.y`` (keywords and commands),
``src/common/DefaultOptions.h`` (options), ``src/mesh/Field.cpp`` (size fields).
"""

from __future__ import annotations

import re


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


STATEMENTS = _words("""
    Point Line Curve Circle Ellipse Ellipsis Spline CatmullRom BSpline Bezier Nurbs Wire Catenary
    Compound Plane Ruled Surface Volume Physical Disk Rectangle Sphere PolarSphere Box Block
    Cylinder Cone Wedge Torus Ellipsoid ThruSections ThickSolid Fillet Chamfer Extrude Rotate
    Translate Symmetry Dilate Affine Intersect Split Sewing HealShapes Coherence Closest Slide
    Parametric CoordinateSystem BooleanUnion BooleanFuse BooleanIntersection BooleanCommon
    BooleanDifference BooleanCut BooleanFragments BooleanCoherence BooleanSection ClassifySurfaces
    CreateGeometry CreateTopology CreateMeshEdges CreateMeshFaces Recursive Delete Transfinite
    TransfQuadTri TransfquadTri TransfQuadtri Transfquadtri Recombine Periodic Degenerated Reverse
    ReverseMesh Duplicata Boundary CombinedBoundary OrientedBoundary PointsOf Smoother MeshSize
    MeshAlgorithm MeshSizeFromBoundary Characteristic Layers Hole ScaleLastLayer Knots Order
    RecombLaterals Recomblaterals QuadTriAddVerts QuadTriNoNewVerts Using In Mesh RefineMesh
    RecombineMesh OptimizeMesh RelocateMesh ReorientMesh TransformMesh RenumberMeshNodes
    RenumberMeshElements SetOrder Field Background BoundaryLayer View TIME INTERPOLATION_SCHEME
    Geometry General SetFactory SetName SetTag SetMaxTag SyncModel NewModel Abort Hide Show
    SetChanged Color BoundingBox DefineConstant DefineNumber DefineString UndefineConstant If ElseIf
    Else EndIf For EndFor Macro Function Return Call Printf Warning Error Include Merge
    MergeWithBoundingBox Left Right AlternateLeft AlternateRight Alternate Volumes SP VP TP SL VL TL
    ST VT TT SQ VQ TQ SS VS TS SH VH TH SI VI TI SY VY TY
""")
"""Words that may begin a statement, also within braces."""

OPERANDS = _words("""
    Abs Fabs Acos ArcCos Asin ArcSin Atan ArcTan Atan2 ArcTan2 Ceil Cos Cosh Exp Floor Fmod Hypot
    Log Log10 Max Min Modulo Rand Round Sin Sinh Sqrt Step Tan Tanh Pi Cpu Memory TotalMemory
    MPI_Rank MPI_Size TestLevel GMSH_MAJOR_VERSION GMSH_MINOR_VERSION GMSH_PATCH_VERSION newp newl
    newc newll newcl news newsl newv newreg newf LinSpace LogSpace List Unique Append Find Exists
    Coordinates Mass CenterOfMass MatrixOfInertia Parent Normal Length Str StrCat StrChoice StrCmp
    StrFind StrLen StrPrefix StrRelative StrReplace StrSub Sprintf UpperCase LowerCase LowerCaseIn
    CurrentDir CurrentDirectory CurrentFileName Today GetNumber GetString GetValue GetStringValue
    GetForced GetForcedStr Loop Loops Union Crack Embedded Euclidian Euclidean Curvature Tangent
    Curves Surfaces Points All Empty Views Meshes Model Physicals Variables Options From Boundary
    Size Progression Power Bump Beta Progression_HWall Bump_HWall Beta_HWall Beta_Symmetrical
    Beta_Symmetrical_HWall Index Name Choices Label Visible ReadOnly ReadOnlyRange Highlight
    AutoCheck Help ShortHelp Units Closed Range NumberFormat MultipleSelection NeverChanged
    ChangedValue Graph Kind Path Attractor AttractorAnisoCurve AutomaticMeshSizeField Ball Constant
    Distance Extend Frustum Gradient IntersectAniso Laplacian LonLat MathEval MathEvalAniso
    MaxEigenHessian Mean MinAniso Octree Param PostView Restrict Threshold
""")
"""Functions, constants, and other words within statements."""

OPTIONS: dict[str, frozenset[str]] = {
    "General": _words("""
    Terminal Verbosity AbortOnError NumThreads ExpertMode NoPopup Axes AxesMikado AxesAutoPosition
    SmallAxes Trackball RotationX RotationY RotationZ RotationCenterGravity RotationCenterX
    RotationCenterY RotationCenterZ ScaleX ScaleY ScaleZ TranslationX TranslationY TranslationZ
    GraphicsWidth GraphicsHeight BoundingBoxSize BackgroundGradient Orthographic Clip0A Clip0B
    Clip0C Clip0D DrawBoundingBoxes Color
"""),
    "Field": _words("""
    AnisoMax Beta BetaLaw CropNegativeValues CurvesList Delta DistMax DistMin EdgesList
    ExcludedFaceList ExcludedFacesList ExcludedSurfacesList F FX FY FZ FacesList FanNodesList
    FanPointsList FanPointsSizesList FieldX FieldY FieldZ FieldsList FromStereo IField IView InField
    IncludeBoundary IncludeEmbedded InnerR1 InnerR2 InnerV1 InnerV2 IntersectMetrics Kind LcMax
    LcMin M11 M12 M13 M22 M23 M33 Max MaxNormal MaxTangent Min MinNormal MinTangent NNodesByEdge
    NbLayers NodesList NumPointsPerCurve OuterR1 OuterR2 OuterV1 OuterV2 OutsideValue PointsList
    Quads Radius RadiusStereo Ratio RegionsList Sampling SetOutsideValue Sigmoid Size SizeFar
    SizeMax SizeMaxNormal SizeMaxTangent SizeMin SizeMinNormal SizeMinTangent SizesList
    StopAtDistMax SurfacesList Thickness UseClosest VIn VOut VerticesList ViewIndex ViewTag
    VolumesList X1 X2 XAxis XCenter XMax XMin Y1 Y2 YAxis YCenter YMax YMin Z1 Z2 ZAxis ZCenter ZMax
    ZMin dMin dMax hwall_n hwall_t hfar ratio thickness hwall_n_nodes fan_angle nPointsPerSurface
    nPointsPerCircle hMin hMax hBulk gradation features NRefine m11 m12 m13 m22 m23 m33 p n
"""),
}
"""Options by group; ``Field`` means size fields."""

NUMBERED = ("Geometry", "Mesh")
"""Groups of which all options are allowed, as they are numbers, except commands for gmsh's window."""

COLOUR = re.compile(
    r"(?:Light|Dark|Medium|Dim|Pale|Deep|Dodger|Royal|Navy|Midnight|Sky|Steel|Slate|Forest|Sea|Spring|Lawn|Olive"
    r"|Dark[A-Z][a-z]+|Hot|Indian|Rosy|Saddle|Sandy|Violet|Orange|Antique|Floral|Ghost|Navajo|Blue|Green|Yellow)?"
    r"(?:Black|White|Red|Green|Blue|Yellow|Orange|Purple|Magenta|Cyan|Brown|Gr[ae]y|Pink|Violet|Gold|Gold(?:en)?rod"
    r"|Khaki|Maroon|Orchid|Salmon|Sienna|Tan|Turquoise|Ivory|Beige|Coral|Tomato|Firebrick|Plum|Thistle)\d{0,3}"
)

JUMPS = _words("If ElseIf Else EndIf For EndFor Macro Function Return Call")

_RUNS = "starts other programs"
_WRITES = "writes files"
_READS = "reads what the scene does not name"
_BUILT = "makes a command of a text"

REFUSED: dict[str, str] = {
    **dict.fromkeys(("SystemCall", "System", "NonBlockingSystemCall", "OnelabRun", "OnelabAction"), _RUNS),
    **dict.fromkeys(("ExternalProcess", "CommandLine", "Solver", "SendToServer", "Plugin"), _RUNS),
    **dict.fromkeys(("Save", "Print", "CreateDir"), _WRITES),
    **dict.fromkeys(("ShapeFromFile", "ListFromFile", "GetEnv", "Open", "FileExists", "Structured"), _READS),
    **dict.fromkeys(("StringToName", "S2N"), _BUILT),
    **dict.fromkeys(("Exit", "Sleep"), "ends or stops gmsh"),
}
"""Reasons for the words that scripts most often contain; words on no list are refused without reason."""

RESERVED = (
    _words("""
    AbsolutePath AdaptMesh Alias AliasWithOptions Betti CodeName Cohomology ColorTable Combine
    CopyOptions DimNameSpace DirName Draw FixRelativePath GeoEntity GmshExecutableName GmshOption
    Homology Levelset N2S NameStruct NameToString ServerAction SetNumber SetPartition SetString
    Struct T2 T3 TextAttributes ThickSolid UnsplitWindow Remesh PartitionMesh CreateOverlaps
    SetCurrentWindow SplitCurrentWindowHorizontal SplitCurrentWindowVertical PostProcessing Post
""")
    - STATEMENTS
)
"""Other keywords of gmsh, which are refused even if a script assigns a value to them."""
