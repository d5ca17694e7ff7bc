"""Rangefinders that the emulator can be: what they say of themselves in answer to VV, PP and II.

The URG-04LX and the URG-04LX-UG01 as recorded; the others after their data sheets.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from bimfit.sensor.scip import Parameters


@dataclass(frozen=True)
class Identity:
    """What the device says of itself in answer to VV, PP and II."""

    product: str
    firmware: str
    serial: str
    model: str
    baud: str
    vendor: str = "Hokuyo Automatic Co.,Ltd."
    protocol: str = "SCIP 2.0"
    speed: str = "Initial(600[rpm])<-Default setting by user"
    mode: str = "CLASSIC"
    status: str = "Sensor works well."


UG01 = Identity(
    "SOKUIKI Sensor URG-04LX-UG01(Simple-URG)",
    "3.4.03(17/Dec./2012)",
    "H1000001",
    "URG-04LX-UG01(Simple-URG)",
    "USB only",
)
URG_04LX = Identity(
    "SOKUIKI Sensor URG-04LX",
    "3.1.04(02/Aug./2007)",
    "H0706400",
    "URG-04LX(Hokuyo Automatic Co.,Ltd.)",
    "19200[bps]<-Default setting by user",
)
UBG_04LX = Identity(
    "SOKUIKI Sensor UBG-04LX-F01",
    "1.0.00(01/Jan./2008)",
    "H0800001",
    "UBG-04LX-F01(Hokuyo Automatic Co.,Ltd.)",
    "19200[bps]<-Default setting by user",
    speed="Initial(2142[rpm])<-Default setting by user",
)
UTM_30LX = Identity(
    "SOKUIKI Sensor TOP-URG UTM-30LX",
    "1.18.02(01/Jan./2012)",
    "H1200001",
    "UTM-30LX(Hokuyo Automatic Co.,Ltd.)",
    "USB only",
    speed="Initial(2400[rpm])<-Default setting by user",
)


@dataclass(frozen=True)
class Model:
    """A kind of rangefinder.

    Attributes
    ----------
    identity : Identity
    parameters : Parameters
    scip1 : bool
        Whether it starts in SCIP 1.1.
    """

    identity: Identity
    parameters: Parameters
    scip1: bool = False


def _model(identity: Identity, *geometry: int, scip1: bool = False) -> Model:
    return Model(identity, Parameters(identity.model, *geometry), scip1)


MODELS: Mapping[str, Model] = MappingProxyType(
    {
        "ug01": _model(UG01, 20, 5600, 1024, 44, 725, 384, 600),
        "urg-04lx": _model(URG_04LX, 20, 5600, 1024, 44, 725, 384, 600, scip1=True),
        "ubg-04lx": _model(UBG_04LX, 20, 5600, 1024, 44, 725, 384, 2142),
        "utm-30lx": _model(UTM_30LX, 23, 60000, 1440, 0, 1080, 540, 2400),
    }
)
