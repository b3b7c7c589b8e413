"""``.ksplat`` files that mkkellogg's GaussianSplats3D 0.4.7 wrote for nine splats of SH degree 2."""

import base64
import zlib

from tests.training.splats.test_formats import random_splats
from training.splats.gaussians import Splats

_TEXTS = (
    (
        "c-rmQ{WH~h6bEo5QCy{xs7ZF^A(l3e_5Gah4b{+UQyF9HcJ11=Xe#Lux7^DlbhB68sfiveaV1)@q}<Q>rZy?nN*-3^S}EFGN~@IB"
        "?zXctJF_$W0lV{k&3Vt9pU-dSt)r`>^XL2(qrdZS4z>}Txq}a@!{hOIJRXn7<MDVr9`8TteLw#@{rdmxdi<$)y#F1W8asBx7g*J>"
        "0qEt_FqXDUNN2%rvQKp!6v-R7z<{d&k|QMY&{mVGeB;IMy1+^)LGR72;J(O}tLr!8#5>nf$(k_|pb3DW)&(@kL<S1K6Of|0O^;q_"
        "Azc-YkS$Q*NU;FJ+G_Cjf<Cgv#f=?)b^*pcC?pLD&5*h14OX-{v3K?)u|?*w?399r#YU=n(xoc~Nv(+6lM#Tu20Jh@v<@V@HU(Z+"
        "+jAds_vs|M9%8KpFdX_Dl$xf3PUbFX2rPz6HA=Pr%?h=%auA%?O=J7+l@a3&m9Wt?i@0`qV0o4SJ5_#;p0KJUn_Ywe0za?_dyJ2*"
        "3Fm0n0bL#2+0nT5T#9}&+v=}R2F0Od$hL=B@>YziMDtlsms>bfY|h0+?wDa^wNWhy7a;Tibsiibbi)diO%kFy&<Spo*Hb%_7)Y9Z"
        "9Av(JptnOG@)DnuHEB|8^eBMVfxB?F*a99}_mhD!XB1^6fcY*dVs1D34A`-bY1ugZT@?w6KFQhlIJ0lwUSLd4t|VG3C0X}LC%k@U"
        "${sT61kXMb?x0HUKIKF=KCl%-pCBC%H-|7Gp%yTg4&i?9Ux<;-Hz?Y#V!n{rqN|x4^K}<eujo7|?-(X+tMk#)y_ObUItEWlkeN85"
        "Lc4o%=vt_YsV~J?KBu0JS7`8Lc@x<0Z3TJBOyRf3teB*h1Tt&w0%p77E)K2z6gr!K2kmBtRU`!GFQbz%#<!7N8&E-aUJ+!!8lgAK"
        "gy2@$1T~inKrnk2>IEYeNxaF}RKQS;LLENu0=2qm#-=?gMM<wc&761`KfBI=*BOUP7iZpr^hzZZ%I1P_@;Rb*f6fJ#C9)C6MzN)R"
        "DHB&5Myh(V7{R`I@PjY|U%U?HZWld-@}%v)E+txZL}3IT2?282E}Y~_7eSH_p}QM(*eMNt)gBGT@bq9WR^Jj6ZLJyETYLaL=H=0l"
        "CJk-R3qnVyROVIMLay7(8r`q$rz@PlM@7a~cu}Ch>H$Bz9xnuYgIdnjMad2(x<gZoA?fIEXUw;Kz;UWO*yZsSMX&GU8hPZQUhh)W"
        "Dh;`S<VM^UF9F7^g}huo#LTyE!>^|MLc+2%__d~rtX&dJ91PzOE+-mSc9u}(mtAU&{}7Xp*<c;6pmjYFSR+rT>X2M?FpR<TFLKpx"
        "6|<nD@iI4AYRqXwH}G?RFA|h1B~RO3K<nnsM$Iw6XXj1Xume{hW$)M8_|;O3%y9x$WIVj8SJ8Jpe=9sfrEfiKn*K8gC*<NLG69Y3"
        "S7Bbd83vD+!On4xpgGP#>_-`ZcTCheeb$(B+8fr}7&ERPM-$tlh|jNjbCpj#IcbU|>l~|PWoJAwc}q1|oUvqnvT<i(md}NN5{A1O"
        "7)^{%*|AAUvT3QMgJe(LK2YnWP?1|R#Kq@gMzV@dh9RQczKR}Q8j3}grqt_T4;{TyusAA8kCV?hMMt0XqGPH7XA;$cZa<#G2Sr*e"
        "H8=nh?r(*$%(F}x0{Rp+;vZv)YE1"
    ),
    (
        "c-rmQdq`7J90%~LX=zwgTKS-u%ca}g?(W^Wcbg2itPBFl9t)AAEHt6iEKPc-&CsCMYoz%{kd{-Y+q}EGk6kMT%N|BiWLarXS&&qi"
        "Xb%ug#h^d?w>Tfp_weQS=YjLbIfx&EOs?q!&t$6qNh-<iSRzd_AP@vW5ClOG1VIo4{gZyb`TZvoI6W~MLnil$G6cChISiQj5AcUa"
        "1wsFvsk=S&>{dI{WxUZ4VK)42|1_pIPId3|{F_Q*-pXKEm)r+N+9F9$e2%qXURF4E?UVZ&X%;Se`<e&Qt@s&x5Euk`E>3B}v}_SI"
        "pIe32={ksHMGN_u-}BP1ul8`o@(kq<{7c&wy2+D79xcvISt~qs`S1eOdyNrXSMMYm>Rq;@nk(9B1x-AP=iNYC=%f^WxCmGCABA`1"
        "-r>rGWV1M~TNWKVL8t37Iof+Dr)X)~)dSRbdoh|$BlJ!z!*xvk7Krf`s#9nHgAr%RE>$L)@9tO6VixlTT|ZOSloRRO)gdXA)y5B#"
        "W!fP!-+Q{zLWJ=@@l>W=+^MSKH=>6ay+rQb!PMBJ2p1}2G1mhyDlxFxAefq<(_CYm@z&?Yo^So4*YcCm7Va=Ut{KpsJ7ThBP*$aZ"
        "FcEiJ192Nk5^t$t=Y8pryRu$zR%uVL>+Chm2Q20M4$=lfuzd;yNqm7IN^zjPHwIw)nbx*t8c%uQ>fA=cGc1je_h5te+1ljG*(yCh"
        "E~}2qU?QC3uG93Ym`j46JJC_cTGSOxEZs{Xh}Y7BCC9y486^~PU-@2cvn9uBX4iNxa06;eX^p+dh2!hNZAG)}5o+?}IcGImV_$*e"
        "4vlAvV-b7Iv()BOC5e=#?LnQ=!1z+^o=!!TXv4_L(%ql^nJnyyI?=f>LCU9-L7D}ujxy61s34GvjS&SPuXc|60hTG+C?8=T3LV0R"
        "o>XyNWFPTVWRISU`Gie!y{^3699DuVfy!YgLs`A^JX+b@O_wyqw35q0y+0fV9(V`1gKRFJ2F|FrNk-jO+%FiHOuq"
    ),
    (
        "c-muNWMBXyFy@3}CI(cXshYN5Ow-ApVHAvlQ7{Td!6+C7qhJ(_f>AIEM!_f;1w#@b_xV}DA`T8bK=OY*1H%VK1_l=B*Z|XLP>q67"
        "Fzf&*Z-2OUWFNy(hrP=r8|{f@zxiY10AlaBk$+gvlvj;Y>!|iqlP|lZ%r@&}Oe*B<V#qzMVAM2sMf1j;RkIdHlmyKFc5vD$`|Mkc"
        "w-;2k%EjvaFnYHuWYdbxPG&XbxxOlutLI<aynbJM+oi|T4^GXyT|0gGa#x8nIiK3B+!~cMPH8Es|KAj4nYeA!j>?Qu@s5(_IoY{O"
        "s@LsYK5tI)o|6mb6l_R#dmmlDB17tF@_yA4tpz%t%<3&ZnC0*2UEX8rwmP9_q2uiM-ok|D-E$(Ucl3sDDa)vKcR2EP`IT>X6z*wv"
        "DfVouGWuu!*m6R3=+e?zd-j$uKeeZ*W@2u8&7;ufxMf|(w=J5^z+iWifk97+Rr|V%iDA)}^}A%vH#e0yx28{=w5<7h=X{q*{RwrI"
        "Sv_(^4I%5|a;|S+VA#>K+R#nozMAyT(rq8NU*8tolQAjO!h6H4KF{TwXH1%#Ufb5Uvp&5(GOc}~lY(AoJjWqTR-HP-la>Y>YAr;}"
        "+UnBZCNEiE```8W*~rrDl8uWGZ|x{r);&2;O4|QQfYL&#+oo3)Rw{BCKHV9lZDZNg)F?7%Q^Tpq+Br>`EtTEYbuN}3p-x-Y_2zm5"
        "0QMC3n*"
    ),
)
FILES = tuple(zlib.decompress(base64.b85decode(text)) for text in _TEXTS)
"""Content for compression 0, 1 and 2, in blocks of 3 units and buckets of 2 splats."""
ORDER = [3, 4, 2, 6, 1, 0, 5, 7, 8]
"""Order of the splats in the files."""


def source() -> Splats:
    """Return the splats in the order of the files."""
    return random_splats(9, 2, 3).select(ORDER)
