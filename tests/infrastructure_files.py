"""Small infrastructure in the structures that the documentation of railML describes.

Written for these tests after https://wiki2.railml.org (2.x: tracks, their topology and elements) and
https://wiki3.railml.org (3.x: net elements and relations, locations); not made by this project.
"""

# ruff: noqa: E501

RAILML_2 = """<?xml version="1.0" encoding="UTF-8"?>
<railml version="2.4" xmlns="https://www.railml.org/schemas/2018" xmlns:dc="http://purl.org/dc/elements/1.1/">
  <metadata><dc:title>valley</dc:title></metadata>
  <infrastructure id="inf1" name="valley">
    <tracks>
      <track id="t1" name="main" mainDir="up">
        <trackTopology>
          <trackBegin id="tb1" pos="0.0" absPos="12000.0"><bufferStop id="bs1" name="end of track A"/>
            <geoCoord coord="47.000 9.000" epsgCode="urn:ogc:def:crs:EPSG::4326"/></trackBegin>
          <trackEnd id="te1" pos="4000.0" absPos="16200.0"><connection id="c1e" ref="c3b"/>
            <geoCoord coord="47.0359708 9.000"/></trackEnd>
          <mileageChanges><mileageChange id="mc1" pos="1500.0" absPosIn="13500.0" absPos="13700.0" type="missing"/></mileageChanges>
          <connections>
            <switch id="sw1" name="W1" pos="1000.0"><connection id="c1a" ref="c2b" orientation="outgoing" course="left"/></switch>
            <switch id="sw2" name="W2" pos="3000.0"><connection id="c1b" ref="c2e" orientation="incoming" course="right"/></switch>
          </connections>
          <crossSections>
            <crossSection id="cs1" pos="500.0" ocpRef="ocpA"/>
            <crossSection id="cs2" pos="2000.0" ocpRef="ocpB"/>
          </crossSections>
        </trackTopology>
        <trackElements>
          <speedChanges>
            <speedChange id="v1" pos="0.0" dir="up" vMax="80"/>
            <speedChange id="v2" pos="2500.0" dir="up" vMax="120"/>
            <speedChange id="v3" pos="2600.0" dir="down" vMax="60"/>
            <speedChange id="v4" pos="4000.0" dir="down" vMax="100"/>
            <speedChange id="v5" pos="0.0" dir="up" vMax="40" trainCategory="freight"/>
          </speedChanges>
          <gradientChanges>
            <gradientChange id="g1" pos="0.0" slope="0.0"/>
            <gradientChange id="g2" pos="800.0" slope="12.5"/>
            <gradientChange id="g3" pos="2200.0" slope="-4"/>
          </gradientChanges>
          <radiusChanges>
            <radiusChange id="r1" pos="0.0" radius="0"/>
            <radiusChange id="r2" pos="1200.0" radius="0" geometryElementDescription="clothoid"/>
            <radiusChange id="r3" pos="1300.0" radius="500"/>
            <radiusChange id="r4" pos="1600.0" radius="-400"/>
            <radiusChange id="r5" pos="1900.0" radius="0"/>
          </radiusChanges>
          <geoMappings><geoMapping id="gm1" pos="2000.0"><geoCoord coord="47.0179854 9.000"/></geoMapping></geoMappings>
          <levelCrossings><levelCrossing id="lc1" pos="100"/></levelCrossings>
        </trackElements>
        <ocsElements><signals><signal id="s1" pos="450" dir="up"/><signal id="s2" pos="600" dir="down"/></signals></ocsElements>
      </track>
      <track id="t2" name="loop">
        <trackTopology>
          <trackBegin id="tb2" pos="0"><connection id="c2b" ref="c1a"/></trackBegin>
          <trackEnd id="te2" pos="2050"><connection id="c2e" ref="c1b"/></trackEnd>
          <crossSections><crossSection id="cs3" pos="1000" ocpRef="ocpB"/></crossSections>
        </trackTopology>
        <trackElements><speedChanges><speedChange id="v6" pos="0" vMax="40"/></speedChanges></trackElements>
      </track>
      <track id="t3" name="onward">
        <trackTopology>
          <trackBegin id="tb3" pos="100" absPos="16200"><connection id="c3b" ref="c1e"/></trackBegin>
          <trackEnd id="te3" pos="1600" absPos="17700"><macroscopicNode id="mn1" ocpRef="ocpC"/></trackEnd>
        </trackTopology>
        <trackElements>
          <speedChanges><speedChange id="v7" pos="100" vMax="100"/></speedChanges>
          <gradientChanges><gradientChange id="g4" pos="100" slope="3"/></gradientChanges>
        </trackElements>
      </track>
    </tracks>
    <trackGroups><line id="l1" name="valley line"><trackRef ref="t1" sequence="1"/><trackRef ref="t3" sequence="2"/></line></trackGroups>
    <operationControlPoints>
      <ocp id="ocpA" name="Anfang"/><ocp id="ocpB" name="Brugg"/><ocp id="ocpC" name="Cham"/><ocp id="ocpD" name="nowhere"/>
    </operationControlPoints>
  </infrastructure>
</railml>
"""
"""Version 2.4: a line with a loop, mileage with a gap, limits by direction, two ways to end a track."""

RAILML_3 = """<?xml version="1.0" encoding="UTF-8"?>
<railML version="3.2" xmlns="https://www.railml.org/schemas/3.2" xmlns:gml="http://www.opengis.net/gml/3.2/">
  <common id="co1">
    <positioning>
      <geometricPositioningSystems><geometricPositioningSystem id="gps1" crsDefinition="EPSG:4326"/></geometricPositioningSystems>
      <linearPositioningSystems><linearPositioningSystem id="lps1" units="km" startMeasure="10000" endMeasure="15000" linearReferencingMethod="absolute"><name name="line 77" language="en"/></linearPositioningSystem></linearPositioningSystems>
    </positioning>
  </common>
  <infrastructure id="is1">
    <topology>
      <netElements>
        <netElement id="ne_a" length="2000.0">
          <relation ref="nr_ab"/>
          <associatedPositioningSystem id="aps1">
            <intrinsicCoordinate id="ic1" intrinsicCoord="0"><geometricCoordinate positioningSystemRef="gps1" x="9.0" y="47.0"/><linearCoordinate positioningSystemRef="lps1" measure="10000"/></intrinsicCoordinate>
            <intrinsicCoordinate id="ic2" intrinsicCoord="1"><geometricCoordinate positioningSystemRef="gps1" x="9.0" y="47.0179854"/><linearCoordinate positioningSystemRef="lps1" measure="12000"/></intrinsicCoordinate>
          </associatedPositioningSystem>
        </netElement>
        <netElement id="ne_b" length="1500.0"/>
        <netElement id="ne_c" length="1550.0"/>
        <netElement id="ne_station"><elementCollectionUnordered id="ecu1"><elementPart ref="ne_b"/><elementPart ref="ne_c"/></elementCollectionUnordered></netElement>
      </netElements>
      <netRelations>
        <netRelation id="nr_ab" positionOnA="1" positionOnB="1" navigability="Both"><elementA ref="ne_a"/><elementB ref="ne_b"/></netRelation>
        <netRelation id="nr_ac" positionOnA="1" positionOnB="0" navigability="Both"><elementA ref="ne_a"/><elementB ref="ne_c"/></netRelation>
        <netRelation id="nr_bc" positionOnA="1" positionOnB="0" navigability="None"><elementA ref="ne_b"/><elementB ref="ne_c"/></netRelation>
      </netRelations>
      <networks><network id="nw1"><level id="lv0" descriptionLevel="Micro"><networkResource ref="ne_a"/><networkResource ref="ne_b"/><networkResource ref="ne_c"/></level><level id="lv1" descriptionLevel="Meso"><networkResource ref="ne_station"/></level></network></networks>
    </topology>
    <geometry>
      <horizontalCurves>
        <horizontalCurve id="hc1" curveType="straight" radius="0" length="1000"><linearLocation id="ll1" applicationDirection="both"><associatedNetElement netElementRef="ne_a" keepsOrientation="true" intrinsicCoordBegin="0" intrinsicCoordEnd="0.5"/></linearLocation></horizontalCurve>
        <horizontalCurve id="hc2" curveType="clothoide" length="200"><linearLocation id="ll2"><associatedNetElement netElementRef="ne_a" keepsOrientation="true" posBegin="1000" posEnd="1200"/></linearLocation></horizontalCurve>
        <horizontalCurve id="hc3" curveType="arc" radius="-600" length="800"><linearLocation id="ll3"><associatedNetElement netElementRef="ne_a" keepsOrientation="true"><linearCoordinateBegin positioningSystemRef="lps1" measure="11200"/><linearCoordinateEnd positioningSystemRef="lps1" measure="12000"/></associatedNetElement></linearLocation></horizontalCurve>
      </horizontalCurves>
      <gradientCurves>
        <gradientCurve id="gc1" curveType="straight" gradient="10"><linearLocation id="ll4"><associatedNetElement netElementRef="ne_a" keepsOrientation="true" intrinsicCoordBegin="0" intrinsicCoordEnd="0.9"/></linearLocation></gradientCurve>
        <gradientCurve id="gc2" curveType="arc" radius="5000" deltaGradient="-14"><linearLocation id="ll5"><associatedNetElement netElementRef="ne_a" keepsOrientation="true" intrinsicCoordBegin="0.9" intrinsicCoordEnd="0.95"/></linearLocation></gradientCurve>
        <gradientCurve id="gc3" curveType="straight" gradient="-4"><linearLocation id="ll6"><associatedNetElement netElementRef="ne_a" keepsOrientation="true" intrinsicCoordBegin="0.95" intrinsicCoordEnd="1"/><associatedNetElement netElementRef="ne_b" keepsOrientation="false" intrinsicCoordBegin="1" intrinsicCoordEnd="0"/></linearLocation></gradientCurve>
      </gradientCurves>
    </geometry>
    <functionalInfrastructure>
      <bufferStops><bufferStop id="bus1"><name name="stop b" language="en"/><spotLocation id="sl1" netElementRef="ne_b" applicationDirection="normal" intrinsicCoord="0"/></bufferStop></bufferStops>
      <operationalPoints>
        <operationalPoint id="op1"><name name="Alt" language="de"/><spotLocation id="sl2" netElementRef="ne_a" intrinsicCoord="0.1"/></operationalPoint>
        <operationalPoint id="op2"><name name="Neu" language="de"/><spotLocation id="sl3" netElementRef="ne_b" intrinsicCoord="0.2"/><spotLocation id="sl4" netElementRef="ne_c" pos="1200"/></operationalPoint>
      </operationalPoints>
      <signalsIS><signalIS id="si1"><spotLocation id="sl5" netElementRef="ne_a" intrinsicCoord="0.5"/></signalIS></signalsIS>
      <speeds>
        <speedSection id="sp1" maxSpeed="100"><linearLocation id="ll7" applicationDirection="both"><associatedNetElement netElementRef="ne_a" keepsOrientation="true"/></linearLocation></speedSection>
        <speedSection id="sp2" maxSpeed="40"><linearLocation id="ll8" applicationDirection="normal"><associatedNetElement netElementRef="ne_c" keepsOrientation="true" intrinsicCoordBegin="0" intrinsicCoordEnd="1"/></linearLocation></speedSection>
        <speedSection id="sp3" maxSpeed="30" isTemporary="true"><linearLocation id="ll9"><associatedNetElement netElementRef="ne_a" keepsOrientation="true" intrinsicCoordBegin="0" intrinsicCoordEnd="1"/></linearLocation></speedSection>
        <speedSection id="sp4" maxSpeed="60"><linearLocation id="ll10"><associatedNetElement netElementRef="ne_b" keepsOrientation="true"/></linearLocation><validForSpeedProfile ref="pr1"/></speedSection>
      </speeds>
      <switchesIS><switchIS id="swi1" type="ordinarySwitch"><name name="77W1" language="en"/><spotLocation id="sl6" netElementRef="ne_a" applicationDirection="normal" intrinsicCoord="1"/><leftBranch netRelationRef="nr_ab"/><rightBranch netRelationRef="nr_ac"/></switchIS></switchesIS>
    </functionalInfrastructure>
  </infrastructure>
</railML>
"""
"""Version 3.2: a switch, locations by share, position and measure, one against its net element."""

TUNNELS_2 = """<tunnels>
            <tunnel id="tu1" pos="900.0" length="450.0" crossSection="46" kind="concrete"/>
            <tunnel id="tu2" pos="3800.0" length="400.0"/>
            <tunnel id="tu3" pos="2000.0"/>
          </tunnels>
          <bridges><bridge id="br1" pos="1500.0" length="80.0"/></bridges>
          """
"""Tunnels of track 'main': one over a switch, one that reaches beyond the track, one of no length."""

TUNNELS_3 = """<overCrossings>
        <overCrossing id="oc1" constructionType="tunnel"><linearLocation id="ll11"><associatedNetElement netElementRef="ne_a" keepsOrientation="true" posBegin="1500" posEnd="2000"/><associatedNetElement netElementRef="ne_b" keepsOrientation="false" intrinsicCoordBegin="1" intrinsicCoordEnd="0.8"/></linearLocation><tunnelResistance crossSection="72.5" wallConstructionType="rock"/></overCrossing>
        <overCrossing id="oc2" constructionType="tunnel"><linearLocation id="ll12"><associatedNetElement netElementRef="ne_c" keepsOrientation="true" posBegin="100" posEnd="300"/></linearLocation></overCrossing>
        <overCrossing id="oc3" constructionType="bridge"><spotLocation id="sl7" netElementRef="ne_c" pos="900"/></overCrossing>
        <overCrossing id="oc4" constructionType="tunnel"><spotLocation id="sl8" netElementRef="ne_c" pos="900"/></overCrossing>
      </overCrossings>
      <underCrossings><underCrossing id="uc1" constructionType="bridge"><spotLocation id="sl9" netElementRef="ne_a" pos="100"/></underCrossing></underCrossings>
      """
"""A tunnel over a joint of net elements, one without a cross-section, bridges."""
